"""Seeds of robosuite's episodes, with a stand-in for the package: versions draw from different generators."""

import importlib
import sys
from types import SimpleNamespace
from unittest.mock import MagicMock, patch

import numpy as np
import pytest

from data_pipelines.simulators import select

(SPEC,) = select(["robosuite_panda_lift"])


class Lift:
    """Base of both: the generator is made with the environment, and nobody else seeds it."""

    def begin(self, draw, seed=None):
        self.rng, self._observables, self.action_spec = np.random.default_rng(seed), {}, ([-1.0], [1.0])
        self._draw, self.model_drawn = draw, draw()
        self.sim = SimpleNamespace(model=SimpleNamespace(_model=None), data=SimpleNamespace(_data=None))

    def reset(self):
        self.start = self._draw()


class DrawsFromNumpy(Lift):
    """As 1.5.1, which has no keyword for the seed."""

    def __init__(self, robots, **how):
        self.begin(np.random.random)


class DrawsFromItsOwn(Lift):
    """As 1.5.2."""

    def __init__(self, robots, seed=None, **how):
        self.begin(lambda: self.rng.random(), seed)


@pytest.fixture(params=[DrawsFromNumpy, DrawsFromItsOwn])
def backend(request):
    """The module as it is imported where the package, MuJoCo too, is what the stand-in is."""
    package, base = MagicMock(), MagicMock(REGISTERED_ENVS={"Lift": request.param})
    package.make = lambda env, **how: base.REGISTERED_ENVS[env](**how)
    names = ("mujoco", "robosuite_models", "robosuite.controllers", "robosuite.environments", "robosuite.models")
    stand_ins = dict.fromkeys(names, MagicMock()) | {"robosuite": package, "robosuite.environments.base": base}
    stand_ins["robosuite.models.base"] = SimpleNamespace(MujocoXML=type("MujocoXML", (), {}))
    with patch.dict(sys.modules, stand_ins):
        for name in ("physics", "picture", "robosuite_backend"):
            sys.modules.pop(f"data_pipelines.simulators.backends.{name}", None)
        yield importlib.import_module("data_pipelines.simulators.backends.robosuite_backend")


def drawn(backend, *seeds: int) -> tuple[float, list[float]]:
    """What a new process draws: the model, and the start of each episode."""
    simulator, starts = backend.Backend(SPEC, 8), []
    for seed in seeds:
        simulator.start("Lift", seed)
        starts.append(simulator.env.start)
    return simulator.env.model_drawn, starts


def test_an_episode_follows_from_its_seed_whatever_ran_before_and_in_whatever_process(backend):
    model, (first, other, again) = drawn(backend, 11, 3, 11)
    assert first == again != other
    assert drawn(backend, 3, 11) == (model, [other, first])
