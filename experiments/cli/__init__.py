"""The `hma` command line: arguments, help and error messages; one file per group of commands.

What the commands do is in `experiments.commands`, file by file. Nothing here imports JAX.
"""
