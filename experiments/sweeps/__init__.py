"""What varies in a study: one file per axis, with its question, its trials and what the page says about it.

`registry` lists them. A new axis is a new file with a function `plan(study) -> Sweep`, and a line in `registry`; an
axis outside the project is run from its file (docs/own_axis.md).
"""
