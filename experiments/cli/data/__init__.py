"""`hma data`: the registry, what a directory holds, other formats, the simulated suites."""
