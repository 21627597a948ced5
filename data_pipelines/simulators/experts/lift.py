"""robosuite's Lift with one arm: above the cube, down, close, up. For OSC_POSE and OSC_POSITION."""

from __future__ import annotations

import numpy as np

from data_pipelines.simulators.behaviour import Expert

GAIN = 10.0  # action per metre
FAST = 0.6  # largest share of full speed
OPEN, CLOSED = -1.0, 1.0
ABOVE = 0.12  # metres over the cube where the hand travels
NEAR = 0.02  # horizontal distance in metres at which the hand may go down
GRASP_STEPS = 8  # steps that the fingers take to close
DROPPED = 0.06  # metres between hand and cube at which it is lost


def expert(backend) -> Expert:
    """The script, which remembers for how long the fingers have been closing."""
    env = backend.env
    site = env.robots[0].eef_site_id["right"]
    closing = 0

    def act() -> np.ndarray:
        nonlocal closing
        hand = backend.data.site_xpos[site]
        cube = backend.data.xpos[env.cube_body_id]
        error = cube - hand
        across = np.linalg.norm(error[:2])
        if closing and np.linalg.norm(error) > DROPPED:
            closing = 0
        if closing or (across < NEAR and abs(error[2]) < NEAR):
            closing += 1
            rise = 0.0 if closing < GRASP_STEPS else 0.5
            return _action(backend, np.array([0.0, 0.0, rise]), CLOSED)
        target = error + [0.0, 0.0, 0.0 if across < NEAR else ABOVE]
        return _action(backend, np.clip(GAIN * target, -FAST, FAST), OPEN)

    return act


def _action(backend, move: np.ndarray, fingers: float) -> np.ndarray:
    """`move` in the world as the arm's first three numbers, turned into the frame of its base."""
    base = backend.env.robots[0].base_ori
    action = np.zeros_like(backend.low)
    action[:3] = np.asarray(base).T @ move
    action[-1] = fingers
    return action
