"""robosuite and robosuite-models: arms, hands and humanoids at a table.

`kwargs` of a spec: `robots`, and instead of their defaults `controller`, that of the whole robot, or
`part`, that of a single arm.
"""

from __future__ import annotations

import logging

import numpy as np
import robosuite
import robosuite_models  # noqa: F401 (registers its robots)
from robosuite.controllers import load_composite_controller_config, load_part_controller_config
from robosuite.models.base import MujocoXML

from data_pipelines.simulators.backends.physics import PhysicsBackend
from data_pipelines.simulators.behaviour import Expert
from data_pipelines.simulators.experts import lift

logging.getLogger("robosuite_logs").setLevel(logging.ERROR)

NEVER = 10**9  # steps


def _hollow_sawyer() -> None:
    """MuJoCo 3.3 refuses meshes of the Sawyer whose volume is nearly zero: load them as shells."""
    load = MujocoXML.__init__

    def patched(self, fname, *args, **kwargs):
        load(self, fname, *args, **kwargs)
        if "sawyer" in str(fname):
            for mesh in self.asset.findall("mesh"):
                mesh.set("inertia", "shell")

    MujocoXML.__init__ = patched


_hollow_sawyer()


class Backend(PhysicsBackend):
    hidden_geoms = (0,)  # collision shapes

    def make(self, env: str) -> None:
        self.env = robosuite.make(
            env,
            robots=self.spec.kwargs["robots"],
            controller_configs=self._controllers(),
            has_renderer=False,
            has_offscreen_renderer=False,
            use_camera_obs=False,
            use_object_obs=False,
            control_freq=round(self.spec.hz * self.spec.repeat),
            horizon=NEVER,
            ignore_done=True,
            hard_reset=False,  # the model is kept, which saves seconds per episode
        )
        for name in self.env._observables:  # computed in every step of the physics, but not used
            self.env.modify_observable(name, "enabled", False)

    def reset(self, seed: int) -> None:
        self.env.reset()  # draws from numpy's global generator (see `start`)
        self.model, self.data = self.env.sim.model._model, self.env.sim.data._data
        self.low, self.high = (np.array(bound, np.float64) for bound in self.env.action_spec)

    def _controllers(self) -> dict | None:
        whole, part = self.spec.kwargs.get("controller"), self.spec.kwargs.get("part")
        if whole is None and part is None:
            return None
        config = load_composite_controller_config(controller=whole, robot=self.spec.kwargs["robots"])
        if part is None:
            return config
        arm = load_part_controller_config(default_controller=part)
        config["body_parts"]["right"] = arm | {"gripper": {"type": "GRIP"}}
        return config

    def advance(self, action: np.ndarray) -> tuple[float, bool]:
        _, reward, _, _ = self.env.step(action)
        return float(reward), bool(self.env._check_success())

    def expert(self) -> Expert | None:
        return lift.expert(self) if self.spec.expert else None

    def rest(self) -> np.ndarray:
        return np.clip(np.zeros_like(self.low), self.low, self.high)
