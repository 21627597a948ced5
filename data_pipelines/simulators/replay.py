"""Replays an episode from its recorded start, under its own or other actions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_pipelines.errors import EpisodeError
from data_pipelines.simulators.embodiments import get_embodiment
from data_pipelines.simulators.episode import Replay, StartState, replay_episode
from data_pipelines.simulators.packages import prepare_process, require_packages
from data_pipelines.simulators.record import START_KEY
from data_pipelines.sources.rlds.dataset import RldsDataset


def read_start(dataset: RldsDataset, episode: int) -> StartState:
    """The start of an episode of the simulator suite. Raises EpisodeError for an episode of another origin."""
    values = dataset.record(episode, [START_KEY]).get(START_KEY)
    if not values:
        raise EpisodeError(
            f"{dataset.name}, episode {episode}: it has no {START_KEY}, so it cannot be simulated again; only "
            "datasets that `hma data sim` wrote have one."
        )
    return StartState.from_json(values[0])


def replay(name: str, start: StartState, actions: Sequence[np.ndarray], size: int = 128) -> Replay:
    """What `actions` [N, A] (raw units) lead to from `start`, with the robot `name` of the table.

    Frames are [N + 1, size, size, 3]: the first shows the start, the last where it ended. The
    recorded actions give the recorded frames (before JPEG) and success. Runs in this process, where
    TensorFlow must not be loaded; for many episodes open one simulator (`backends.open_simulator`)
    and call `episode.replay_episode`.
    """
    spec = get_embodiment(name)
    require_packages([spec])
    prepare_process()
    from data_pipelines.simulators.backends import open_simulator

    simulator = open_simulator(spec, size)
    try:
        return replay_episode(simulator, start, actions)
    finally:
        simulator.close()
