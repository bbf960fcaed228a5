"""A symbolic twin of the simulated vehicle for CasADi, and model predictive control with it.

`casadi_model` makes it from the traced program of the physics; `Mpc` follows setpoints with it. Both need CasADi:
the extra `casadi`.
"""

from jaxdrones.symbolic.model import CasadiModel, casadi_model
from jaxdrones.symbolic.mpc import Mpc

__all__ = ["CasadiModel", "Mpc", "casadi_model"]
