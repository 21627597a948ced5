"""Push-T: the disc goes behind the T, as seen from the goal, and pushes. Seldom enough to succeed."""

from __future__ import annotations

import numpy as np

from data_pipelines.simulators.behaviour import Expert

BEHIND = 90.0  # pixels behind the T where pushing starts
AROUND = 110.0  # pixels from the T at which the disc goes round it
STEP = 35.0  # pixels that the target runs ahead of the disc


def expert(env) -> Expert:
    def act() -> np.ndarray:
        disc = np.array(env.agent.position)
        block = np.array(env.block.local_to_world(env.block.center_of_gravity))
        way = np.asarray(env.goal_pose[:2]) - np.array(env.block.position)
        far = np.linalg.norm(way)
        way = way / far if far > 15 else _turning(env, disc - block)
        offset = disc - block
        along, lateral = offset @ way, offset @ [-way[1], way[0]]
        if along < 0 and abs(lateral) < 25:
            return disc + STEP * way
        target = block - BEHIND * way
        if along > -20:  # on the wrong side: round the T, not through it
            side = np.array([-way[1], way[0]]) * (1.0 if lateral >= 0 else -1.0)
            target = block + AROUND * side - 0.5 * BEHIND * way
        step = target - disc
        return disc + step * min(1.0, STEP / max(np.linalg.norm(step), 1e-9))

    return act


def _turning(env, offset: np.ndarray) -> np.ndarray:
    """If the T is in its place but turned: where to push across, on the side where the disc is."""
    error = (env.goal_pose[2] - env.block.angle + np.pi) % (2 * np.pi) - np.pi
    across = np.array([-offset[1], offset[0]]) / max(np.linalg.norm(offset), 1e-9)
    return across * (1.0 if error >= 0 else -1.0)
