"""Control: from a force setpoint to two motor duties, as pure functions of explicit state."""
