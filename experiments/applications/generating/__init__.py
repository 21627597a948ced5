"""Trajectories that a learned simulator generates under recorded actions (Table 6 of the paper).

`trajectories` are recordings as they are replayed, `source` replays them for `data_pipelines.convert`, which writes
RLDS restartably, `compare` holds what was written against what was recorded.
"""
