"""Bullet backend: contacts, cameras, a window. Needs the extra `bullet`."""

from jaxdrones.engine.bullet.contacts import Contact
from jaxdrones.engine.bullet.make import make_step
from jaxdrones.engine.bullet.step import BulletStep
from jaxdrones.engine.bullet.window import Window

__all__ = ["BulletStep", "Contact", "Window", "make_step"]
