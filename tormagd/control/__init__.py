"""Control: from a force setpoint to two motor duties, in stages that hold their own state."""
