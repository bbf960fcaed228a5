"""What the command line does with learners: presets, runs, the training loop, and Stable-Baselines3."""
