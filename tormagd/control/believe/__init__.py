"""What is believed of the device: its strength, memory, zero, and whether its sensor is."""
