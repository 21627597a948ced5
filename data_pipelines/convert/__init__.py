"""Converters: other people's formats in, one RLDS directory out.

`robomimic`, `lerobot`, `epic_kitchens`, `ego4d` and `egoexo4d` each open a source and yield its
episodes; `write.convert` writes any of them, restartably. Nothing here is needed to train.
"""
