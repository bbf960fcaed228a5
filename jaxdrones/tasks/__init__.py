"""Tasks: how episodes start, where drones should be, what is rewarded, and when an episode ends."""
