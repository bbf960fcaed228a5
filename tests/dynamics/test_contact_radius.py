"""Radius within which a drone can touch something."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers import jit_unoptimized

import jaxdrones
from jaxdrones import State, ground_contact, rotation
from jaxdrones.dynamics.contact import contact_radius


def test_contact_begins_at_the_contact_radius_in_the_most_unfavorable_attitude():
    params = jaxdrones.load_params("cf2x").replace(collision_offset=jnp.array(-0.05))
    radius, still = contact_radius(params), jax.tree.map(lambda x: x[0], State.at_rest(jnp.zeros((1, 3))))

    @jit_unoptimized
    def touches(height):
        def force(pitch):
            quat = rotation.from_rpy(jnp.stack([0 * pitch, pitch, 0 * pitch]))
            return ground_contact(params, still.replace(pos=jnp.array([0, 0, height]), quat=quat)).force

        return jnp.any(jax.vmap(force)(jnp.linspace(-np.pi, np.pi, 361)) != 0)

    assert touches(0.999 * radius) and not touches(1.001 * radius)
