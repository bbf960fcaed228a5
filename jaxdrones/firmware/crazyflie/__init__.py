"""Simulated Crazyflie, to which cflib connects over UDP."""

from jaxdrones.firmware.crazyflie.firmware import Crazyflie
from jaxdrones.firmware.crazyflie.server import Flown, Server
from jaxdrones.firmware.crazyflie.vehicle import Vehicle

__all__ = ["Crazyflie", "Flown", "Server", "Vehicle"]
