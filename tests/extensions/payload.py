"""A point mass that hangs from two drones of a team by damped spring cables."""

import dataclasses

import jax
import jax.numpy as jnp

import jaxdrones as jd


@dataclasses.dataclass(frozen=True)
class Payload:
    """The load, its cables, and the drones that they hang from."""

    carriers: tuple[int, int] = (0, 1)
    mass: float = 0.008  # kg
    length: float = 0.5  # m, of a cable without tension
    stiffness: float = 8.0  # N/m
    damping: float = 0.05  # N s/m

    @property
    def model(self) -> jd.Model:
        """`state.aux["payload"]`: position and velocity of the load, world, the same in the row of every drone."""
        return jd.Model("payload", self._init, self._rate, of_team=True)

    def effect(self, params, state):
        """Tension of the cables on the drones, at their centers of mass."""
        tension = self._tension(state)
        force = jnp.zeros_like(state.pos).at[jnp.array(self.carriers)].add(-tension)
        force = jax.vmap(jd.rotation.rotate_inverse)(state.quat, force)
        return jd.Wrench(force, jnp.zeros_like(force))

    def _init(self, params):
        return {"pos": jnp.zeros((len(params.mass), 3)), "vel": jnp.zeros((len(params.mass), 3))}

    def _rate(self, params, state, command):
        weight = -self.mass * jd.vector.along_z(params.gravity[0])
        acc = (jnp.sum(self._tension(state), axis=0) + weight) / self.mass
        return {"pos": state.aux["payload"]["vel"], "vel": jnp.broadcast_to(acc, state.pos.shape)}

    def _tension(self, state):
        """Forces (2, 3) of the cables on the load, N, world; a slack cable exerts none."""
        carriers = jnp.array(self.carriers)
        span = state.pos[carriers] - state.aux["payload"]["pos"][:1]
        vel = state.vel[carriers] - state.aux["payload"]["vel"][:1]
        length = jnp.sqrt(jnp.sum(span**2, axis=1, keepdims=True))
        along = span / length
        stretch, rate = length - self.length, jnp.sum(vel * along, axis=1, keepdims=True)
        return jnp.where(stretch > 0, self.stiffness * stretch + self.damping * rate, 0) * along
