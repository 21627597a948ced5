"""Export of any `sources.convertible` source as one RLDS directory, resumable.

Nothing here is needed to train: every command reads such sources directly.
"""
