"""Other simulators, run in an environment of their own."""
