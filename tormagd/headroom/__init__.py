"""What this machine holds, measured: a reference loop, a bare timer, the core's own cost. No daemon and no device."""
