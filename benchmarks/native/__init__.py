"""The plant in hand-written C."""
