"""Training at the command line: presets, recipes, runs on disk, the training loop, and Stable-Baselines3."""
