import jax.numpy as jnp
import numpy as np

from jaxdrones import Wrench

rng = np.random.default_rng(0)


def test_wrenches_add_up():
    force, torque = rng.normal(size=(2, 2, 3))
    total = Wrench(force[0], torque[0]) + Wrench(force[1], torque[1])
    np.testing.assert_array_equal(total.force, force[0] + force[1])
    np.testing.assert_array_equal(total.torque, torque[0] + torque[1])


def test_a_force_through_the_centre_of_mass_has_no_torque():
    wrench = Wrench.of_force(jnp.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(wrench.force, [1, 2, 3])
    np.testing.assert_array_equal(wrench.torque, 0)


def test_thrusts_act_at_the_rotors():
    rotor_pos, thrust = rng.normal(size=(4, 3)), rng.normal(size=4)
    forces = thrust[:, None] * [0, 0, 1]
    wrench = Wrench.of_thrusts(jnp.array(rotor_pos), jnp.array(thrust))
    np.testing.assert_allclose(wrench.force, forces.sum(axis=0), atol=1e-15)
    np.testing.assert_allclose(wrench.torque, np.cross(rotor_pos, forces).sum(axis=0), atol=1e-15)
