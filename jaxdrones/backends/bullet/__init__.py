"""PyBullet behind the step of the explicit backend: contacts, cameras, a window. Needs the extra `bullet`."""

from jaxdrones.backends.bullet.camera import Camera
from jaxdrones.backends.bullet.contacts import Contact
from jaxdrones.backends.bullet.step import BulletStep, make_step
from jaxdrones.backends.bullet.window import Window

__all__ = ["BulletStep", "Camera", "Contact", "Window", "make_step"]
