"""The simulated TorMag device: a plant and its firmware behind protocol bytes, in virtual or in real time."""
