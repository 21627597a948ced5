"""What a program prints: progress, tables, messages, and the exit code that an error becomes."""
