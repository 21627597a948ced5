"""Programs that strain one promise for minutes and print what they found; small versions run as tests."""
