"""What a dataset of unknown origin holds, and the registry entry that would read it."""
