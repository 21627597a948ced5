"""Named lists of datasets: the official release's splits (reference section 5.4), and those of its forty datasets that
are published.

`FORTY` is ordered such that its first 5, 10 and 20 are the release's own subsets. Its list of
thirty holds one dataset that its forty lack; the thirty of `FORTY` are 29 of those and one more.
"""

from __future__ import annotations

from hma_jax.config import ConfigError

_LONG = "_converted_externally_to_rlds"

FORTY = (
    "bridge_data_v2",
    "fractal20220817_data",
    "language_table",
    f"kaist_nonprehensile{_LONG}",
    f"ucsd_pick_and_place_dataset{_LONG}",
    # 10
    f"ucsd_kitchen_dataset{_LONG}",
    "berkeley_fanuc_manipulation",
    "bc_z",
    "cmu_play_fusion",
    "kuka",
    # 20
    f"utokyo_xarm_bimanual{_LONG}",
    f"stanford_hydra_dataset{_LONG}",
    f"austin_sirius_dataset{_LONG}",
    f"berkeley_mvp{_LONG}",
    "robo_net",
    f"furniture_bench_dataset{_LONG}",
    f"dlr_sara_grid_clamp{_LONG}",
    "cmu_stretch",
    "droid",
    "toto",
    # 30
    f"berkeley_rpt{_LONG}",
    f"iamlab_cmu_pickup_insert{_LONG}",
    "qut_dexterous_manpulation",
    "io_ai_tech",
    "conq_hose_manipulation",
    "dobbe",
    "berkeley_gnm_cory_hall",
    "roboturk",
    "nyu_door_opening_surprising_effectiveness",
    "spoc",
    # 40
    "columbia_cairlab_pusht_real",
    "plex_robosuite",
    f"usc_cloth_sim{_LONG}",
    "berkeley_cable_routing",
    "imperial_wrist_dataset",
    "metaworld",
    "robomimic",
    "epic_kitchen",
    "ego4d",
    "exoego4d",
)

_NOT_FOR_VAE = (
    "bridge_data_v2", "fractal20220817_data", f"furniture_bench_dataset{_LONG}", "spoc",
    "conq_hose_manipulation", f"usc_cloth_sim{_LONG}", "metaworld", "epic_kitchen", "ego4d", "exoego4d",
)  # fmt: skip

_NOT_AS_RLDS = ("metaworld", "robomimic", "epic_kitchen", "ego4d", "exoego4d")
_PUBLISHED_AS = {"imperial_wrist_dataset": "imperialcollege_sawyer_wrist_cam"}

MIXTURES: dict[str, tuple[str, ...]] = {
    "dataset5": FORTY[:5],
    "dataset10": FORTY[:10],
    "dataset20": FORTY[:20],
    "dataset30": (*FORTY[:29], f"cmu_franka_exploration_dataset{_LONG}"),
    "dataset40": FORTY,
    # Datasets of the forty that anybody can download as RLDS, under the names in their files (docs/sweeps.md).
    "dataset40_published": tuple(_PUBLISHED_AS.get(name, name) for name in FORTY if name not in _NOT_AS_RLDS),
    # The thirty of the released continuous model.
    "dataset30_vae": tuple(name for name in FORTY if name not in _NOT_FOR_VAE),
}


def get_mixture(name: str) -> tuple[str, ...]:
    """The datasets of a named mixture. Raises ConfigError, listing the names, if there is none."""
    if name not in MIXTURES:
        raise ConfigError(f"unknown mixture {name!r}; known: {', '.join(MIXTURES)}")
    return MIXTURES[name]
