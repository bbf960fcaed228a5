"""Flight controllers' firmware and its protocols: Betaflight in the loop, and a simulated Crazyflie."""
