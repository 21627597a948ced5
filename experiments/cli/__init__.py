"""The `hma` command line: one file per group of commands, each with its signature, its help and what it does.

Heavy imports happen inside the commands: help and errors need no JAX.
"""
