"""The export: any source made of units (`sources.units`) as one RLDS directory, restartably.

Nothing here is needed to train: every command reads such sources directly.
"""
