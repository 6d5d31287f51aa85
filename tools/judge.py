"""Judges what tormagd does to simulated devices, one judge a NAME; `--help` after it says what it shows."""

import sys

from judge.frame import parsed, told

JUDGES = {
    "tracking": "how well a force is followed, and how soon a device is known",
    "envelope": "the whole path at the corners: hands, devices, forces, setpoints",
    "models": "the shipped models beside devices",
    "contact": "what a hand feels of a wall",
    "faults": "the fault matrix on a serial line and on a CAN bus",
    "numerics": "the physics in 50 digits, hostile inputs to every stage",
    "endure": "long, destructive cases: fuzz, replug, soak",
}


def main() -> int:
    module, options = parsed("judge", JUDGES)
    return told(module, options, module.measure(options))


if __name__ == "__main__":
    sys.exit(main())
