"""A vehicle as a log shows it."""

from __future__ import annotations

from jaxdrones.identification.instruments import Instruments
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode


class Vehicle(PyTreeNode):
    """The constants of one drone and of the instruments that log its flights."""

    params: Params
    instruments: Instruments

    @classmethod
    def of(cls, params: Params) -> Vehicle:
        """A vehicle whose instruments show what is."""
        return cls(params, Instruments.ideal())
