"""The viewer: flights as one page of HTML with everything in it, for notebooks and for files."""

from jaxdrones.visualization.viewer.page import Page
from jaxdrones.visualization.viewer.show import show

__all__ = ["Page", "show"]
