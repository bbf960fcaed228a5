"""Figures and films of flights."""
