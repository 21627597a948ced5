"""The paper's forty datasets as far as parameter counts need them: action size and stride.

Values are (action dimensions, stride to 2 Hz) as the official release uses them (reference
section 5.4; four sizes are not certain). The order makes the first 5, 10 and 20 the release's
own subsets; its list of 30 holds one dataset that the forty lack, so that subset is 29 of
those and one more. Long names are cut before `_converted_externally_to_rlds`.
"""

PAPER_MIXTURE: dict[str, tuple[int, int]] = {
    "bridge_data_v2": (7, 1),
    "fractal20220817_data": (13, 1),
    "language_table": (2, 1),
    "kaist_nonprehensile": (20, 5),
    "ucsd_pick_and_place": (4, 1),
    # 10
    "ucsd_kitchen": (8, 1),
    "berkeley_fanuc_manipulation": (6, 1),
    "bc_z": (70, 5),
    "cmu_play_fusion": (9, 2),
    "kuka": (13, 1),
    # 20
    "utokyo_xarm_bimanual": (14, 1),
    "stanford_hydra": (7, 5),
    "austin_sirius": (7, 10),
    "berkeley_mvp": (8, 2),
    "robo_net": (5, 1),
    "furniture_bench": (8, 5),
    "dlr_sara_grid_clamp": (7, 1),
    "cmu_stretch": (8, 1),
    "droid": (7, 7),
    "toto": (8, 15),
    # 30
    "berkeley_rpt": (8, 15),
    "iamlab_cmu_pickup_insert": (8, 10),
    "qut_dexterous_manipulation": (8, 1),
    "io_ai_tech": (7, 1),
    "conq_hose_manipulation": (7, 15),
    "dobbe": (7, 1),
    "berkeley_gnm_cory_hall": (2, 1),
    "roboturk": (8, 5),
    "nyu_door_opening": (8, 1),
    "spoc": (9, 1),
    # 40
    "columbia_cairlab_pusht_real": (8, 5),
    "plex_robosuite": (7, 1),
    "usc_cloth_sim": (4, 5),
    "berkeley_cable_routing": (7, 5),
    "imperial_wrist_dataset": (8, 1),
    "metaworld": (4, 3),
    "robomimic": (7, 3),
    "epic_kitchen": (4, 15),
    "ego4d": (4, 1),
    "exoego4d": (4, 15),
}
