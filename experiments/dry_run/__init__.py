"""What is known of a study before it runs: what it costs, what of it is done, and whether its trials can be trained."""
