"""What is known about a study before it runs: what it costs, which parts are done, and whether its trials can be
trained."""
