"""What is measured on the embedded suite itself, before any model: commands and their tables."""
