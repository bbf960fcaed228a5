"""Training at the command line: presets, recipes, runs on disk and the training loop."""
