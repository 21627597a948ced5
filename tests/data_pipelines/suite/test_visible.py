"""What is said to be seen of objects is what the renderer shows of them."""

import numpy as np
import pytest

from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.render import render_frames
from data_pipelines.suite.rollout import episode_seeds, simulate
from data_pipelines.suite.simulator import SPECS
from data_pipelines.suite.visible import object_colours, visible_shares

AWAY = 9.0


@pytest.mark.parametrize("robot", ["gripper_wood", "arm_chalk"])
def test_the_share_that_is_seen_is_that_of_the_pixels_an_object_changes(robot):
    spec = SPECS[robot]
    rollout = simulate(spec, episode_seeds(spec, 40, 0, "val"))
    q = rollout.q[:, ::8].reshape(-1, spec.body.size)
    objects = rollout.objects[:, ::8].reshape(-1, spec.task.objects, 2)
    episode = np.repeat(np.arange(40), len(q) // 40)
    looks = draw_appearance(spec, rollout.seeds)

    def changed(objects: np.ndarray, k: int) -> np.ndarray:
        """Pixels that differ without object k, by more than its soft shadow does."""
        without = objects.copy()
        without[:, k] = AWAY
        pair = [render_frames(spec, looks, rollout.goals, q, o, episode).astype(int) for o in (objects, without)]
        return (np.abs(pair[0] - pair[1]).max(-1) > 30).sum((1, 2))

    share = visible_shares(spec, q, objects)[:, 0]
    pixels = changed(objects, 0)
    whole, little = share == 1, share < 0.4
    assert whole.sum() > 20 and little.sum() > 2
    assert pixels[little].mean() < 0.6 * np.mean(pixels[whole])
    assert np.corrcoef(share, pixels)[0, 1] > 0.85


def test_an_object_has_the_colour_that_is_said():
    spec, seeds = SPECS["gripper_wood"], [3, 4, 5, 6, 7]
    order = object_colours(spec, seeds)
    shown = draw_appearance(spec, seeds).objects[..., :3]
    palette = np.array(spec.palette.objects, float)
    away = np.abs((shown[:, :, None] - 128) / 0.6 + 128 - palette).mean(-1)  # contrast undone; light varies by 3 %
    assert (away.argmin(-1) == order).all()
    assert len({tuple(row) for row in order.tolist()}) > 1
