"""Training runs of the command line: presets, recipes, files and training loop."""
