"""Stage of the control core."""
