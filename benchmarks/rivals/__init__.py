"""Other simulators, run in a separate environment."""
