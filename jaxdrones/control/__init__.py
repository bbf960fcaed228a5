"""Controllers of one drone: `control(gains, params, memory, state, setpoint, dt=...) -> (memory, rpm)`."""
