"""Entries of one's own, and of three small samples of real robot data.

A dataset of one's own is one more `DatasetSpec` here; `hma data inspect DIR` suggests its fields. For
entries outside this project see `toml_file`.
"""

from __future__ import annotations

from data_pipelines.registry.spec import DatasetSpec

OWN = (
    DatasetSpec(
        "bridge_dataset",
        image_key="observation/image_0",
        action_keys=("action",),
        action_dims=(7,),
        hz=5,
        camera="over the shoulder, fixed",
        note="WidowX, Bridge V2: end-effector deltas and gripper",
        version="1.0.0",
        episodes=25,
        median_steps=10,
    ),
    DatasetSpec(
        "droid_sample",
        image_key="observation/exterior_image_1_left",
        action_keys=("action_dict/cartesian_position", "action_dict/gripper_position"),
        action_dims=(6, 1),
        hz=5,
        camera="exterior, fixed",
        note="Franka, DROID at 5 Hz: absolute end-effector pose and gripper",
        version="1.0.0",
        episodes=7,
        median_steps=80,
        angles=(3, 5),  # roll and yaw
        angle_form="sine_cosine",
    ),
    DatasetSpec(
        "unitree_g1_sample",
        image_key="observation/image",
        action_keys=("action",),
        action_dims=(26,),
        hz=30,
        camera="head",
        note="Unitree G1, two arms and hands: absolute joint targets",
        version="1.0.0",
        episodes=8,
        median_steps=380.5,
    ),
)
