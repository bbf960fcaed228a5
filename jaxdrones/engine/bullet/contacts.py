"""Contact points and forces between bodies."""

import dataclasses

import numpy as np

from jaxdrones.engine.bullet.client import Client


@dataclasses.dataclass(frozen=True)
class Contact:
    """One contact point of two bodies."""

    body: str
    """`drone i`."""
    other: str
    """`ground`, `obstacle i` or `drone j`."""
    pos: np.ndarray
    """(3,) on `other`, m, world."""
    normal: np.ndarray
    """(3,) unit vector from `other` to `body`, world."""
    force: float
    """Normal force, N."""
    impulse: float
    """Normal impulse of the physics step, N s."""
    depth: float
    """Penetration, m; negative for a gap within the collision margin."""


def contacts_of_last_step(client: Client, dt: float) -> list[Contact]:
    """Contacts with a force in Bullet's last physics step of length dt (s)."""
    names, contacts = client.names(), []
    for point in client.p.getContactPoints(physicsClientId=client.id):
        first, second, on_second, normal, distance, force = point[1], point[2], point[6], point[7], point[8], point[9]
        if force <= 0:
            continue
        pos, normal = np.array(on_second), np.array(normal)
        if first not in client.drones:  # `body` is a drone
            first, second, pos, normal = second, first, np.array(point[5]), -normal
        contacts.append(Contact(names[first], names[second], pos, normal, force, force * dt, -distance))
    return contacts
