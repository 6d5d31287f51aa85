"""Which gap gives the force."""
