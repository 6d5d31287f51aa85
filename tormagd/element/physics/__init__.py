"""What the device is: field, magnetoelastic brake force, friction, relaxation, inserts, magnets."""
