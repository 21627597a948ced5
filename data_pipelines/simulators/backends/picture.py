"""Fast rendering of a MuJoCo model on a CPU.

Shadows, reflections and multisampling take ten times as long as the rest on a software renderer: they are off, and
edges are antialiased by rendering at twice the size. The packages' own renderers are not used:
robosuite's sometimes returns uninitialised memory, and gym-aloha's draws 640 x 480 in every step.
"""

from __future__ import annotations

import mujoco
import numpy as np

from data_pipelines.simulators.spec import View

OVERSAMPLE = 2


class Picture:
    """A view of one model. Belongs to the process and thread that made it."""

    def __init__(self, model: mujoco.MjModel, view: View, size: int, hidden_geoms: tuple[int, ...] = ()):
        """`hidden_geoms`: groups of geoms that are not drawn, such as collision shapes."""
        self.size, self.view = size, view
        side = size * OVERSAMPLE
        model.vis.quality.offsamples = 0  # before the renderer is made
        model.vis.global_.offwidth = model.vis.global_.offheight = side
        self.renderer = mujoco.Renderer(model, height=side, width=side, max_geom=20_000)
        self.renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self.renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self.option = mujoco.MjvOption()
        self.option.geomgroup[list(hidden_geoms)] = 0
        self.camera = _camera(model, view)

    def draw(self, data: mujoco.MjData) -> np.ndarray:
        """uint8 [size, size, 3]."""
        if self.view.follow:  # by hand: MuJoCo's own following depends on what was drawn before
            self.camera.lookat[:] = data.body(self.view.follow).xpos
        self.renderer.update_scene(data, camera=self.camera, scene_option=self.option)
        large = self.renderer.render()
        parts = large.reshape(self.size, OVERSAMPLE, self.size, OVERSAMPLE, 3)
        image = (parts.sum(axis=(1, 3), dtype=np.uint16) // OVERSAMPLE**2).astype(np.uint8)
        return image[::-1, ::-1] if self.view.turned else image

    def close(self) -> None:
        self.renderer.close()


def _camera(model: mujoco.MjModel, view: View) -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    if view.name:
        camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        camera.fixedcamid = model.camera(view.name).id
        return camera
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat[:] = view.lookat
    camera.distance, camera.azimuth, camera.elevation = view.distance, view.azimuth, view.elevation
    return camera
