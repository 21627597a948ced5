"""Where trials run: on this machine, through Slurm, on a Ray cluster. Each in a file of its own, named in
`registry`."""
