"""A motor log, and what it says of motor and screw."""
