"""The step of a world: wrenches summed, integrated by JAX (`explicit`) or by Bullet (`bullet`)."""
