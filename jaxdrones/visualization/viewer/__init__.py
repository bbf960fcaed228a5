"""Viewer: self-contained HTML pages of flights, for notebooks, files and live views."""

from jaxdrones.visualization.viewer.live import Live
from jaxdrones.visualization.viewer.page import Page
from jaxdrones.visualization.viewer.show import show

__all__ = ["Live", "Page", "show"]
