"""How many episodes each published Open-X dataset has, and how long they are, where that is published.

Episodes are those of the split `train` in the dataset_info.json of the published directories, as the tfds catalogue
shows them too. No public file says how long the episodes are; where the number of steps of the whole dataset is
published, the mean per episode is given.
"""

from __future__ import annotations

LONG = "_converted_externally_to_rlds"

EPISODES: dict[str, int] = {
    "aloha_mobile": 276, f"asu_table_top{LONG}": 110, f"austin_buds_dataset{LONG}": 50,
    f"austin_sailor_dataset{LONG}": 240, f"austin_sirius_dataset{LONG}": 559, "bc_z": 39_350,
    "berkeley_autolab_ur5": 896, "berkeley_cable_routing": 1_482, "berkeley_fanuc_manipulation": 415,
    "berkeley_gnm_cory_hall": 7_331, "berkeley_gnm_recon": 11_834, "berkeley_gnm_sac_son": 2_955,
    f"berkeley_mvp{LONG}": 480, f"berkeley_rpt{LONG}": 908, "bridge": 25_460, "bridge_data_msr": 822,
    f"cmu_franka_exploration_dataset{LONG}": 199, "cmu_play_fusion": 576, "cmu_playing_with_food": 4_200,
    "cmu_stretch": 135, "columbia_cairlab_pusht_real": 122, "conq_hose_manipulation": 113,
    f"dlr_edan_shared_control{LONG}": 104, f"dlr_sara_grid_clamp{LONG}": 107, f"dlr_sara_pour{LONG}": 100,
    "dobbe": 5_208, "droid": 95_658, "eth_agent_affordances": 118, "fmb": 8_611, "fractal20220817_data": 87_212,
    f"furniture_bench_dataset{LONG}": 5_100, f"iamlab_cmu_pickup_insert{LONG}": 631,
    "imperialcollege_sawyer_wrist_cam": 170, "io_ai_tech": 3_847, "jaco_play": 976,
    f"kaist_nonprehensile{LONG}": 201, "kuka": 580_392, "language_table": 442_226,
    f"maniskill_dataset{LONG}": 30_213, "mimic_play": 378, "nyu_door_opening_surprising_effectiveness": 435,
    f"nyu_franka_play_dataset{LONG}": 365, f"nyu_rot_dataset{LONG}": 14, "plex_robosuite": 402,
    "qut_dexterous_manpulation": 200, "robo_net": 82_775, "robo_set": 18_250, "roboturk": 1_796,
    "spoc": 212_043, "spoc_robot": 212_043, f"stanford_hydra_dataset{LONG}": 570,
    f"stanford_kuka_multimodal_dataset{LONG}": 3_000, f"stanford_mask_vit{LONG}": 9_109,
    f"stanford_robocook{LONG}": 2_460, "taco_play": 3_242, f"tokyo_u_lsmo{LONG}": 50, "toto": 902,
    f"ucsd_kitchen_dataset{LONG}": 150, f"ucsd_pick_and_place_dataset{LONG}": 1_355, "uiuc_d3field": 192,
    f"usc_cloth_sim{LONG}": 800, "utaustin_mutex": 1_500, f"utokyo_pr2_opening_fridge{LONG}": 64,
    f"utokyo_pr2_tabletop_manipulation{LONG}": 192, f"utokyo_saytap{LONG}": 20,
    f"utokyo_xarm_bimanual{LONG}": 64, f"utokyo_xarm_pick_and_place{LONG}": 92, "viola": 135,
}  # fmt: skip

STEPS: dict[str, int] = {"fractal20220817_data": 3_786_400, "language_table": 7_045_476}
"""Number of steps of all episodes together."""


def mean_steps(name: str) -> float:
    """Mean steps per episode, to a tenth; 0: unknown."""
    return round(STEPS[name] / EPISODES[name], 1) if name in STEPS else 0.0
