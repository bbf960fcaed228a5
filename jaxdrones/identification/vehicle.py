"""A vehicle together with the measurement model of its logs."""

from __future__ import annotations

from jaxdrones.identification.instruments import Instruments
from jaxdrones.params import Params
from jaxdrones.pytree import PyTreeNode


class Vehicle(PyTreeNode):
    """Parameters of one drone, and of the instruments that log its flights."""

    params: Params
    instruments: Instruments

    @classmethod
    def of(cls, params: Params) -> Vehicle:
        """A vehicle with ideal instruments."""
        return cls(params, Instruments.ideal())
