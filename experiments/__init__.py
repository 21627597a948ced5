"""The composition root: trials, sweeps, ledger, plots, reports and the `hma` command line."""
