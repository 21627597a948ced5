"""What a user gives besides options: settings (`--set`) and Python files."""
