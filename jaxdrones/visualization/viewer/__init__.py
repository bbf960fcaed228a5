"""The viewer: flights as one page of HTML with everything in it, for notebooks, for files, and while they fly."""

from jaxdrones.visualization.viewer.live import Live
from jaxdrones.visualization.viewer.page import Page
from jaxdrones.visualization.viewer.show import show

__all__ = ["Live", "Page", "show"]
