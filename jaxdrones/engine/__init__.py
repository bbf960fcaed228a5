"""Steps of a world, integrated by JAX (`explicit`) or by Bullet (`bullet`)."""
