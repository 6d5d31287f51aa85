"""`python -m tormagd.simulation`: the simulated device as a process of its own."""

import argparse
import contextlib
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from firmware_protocol.c.build import BuildError
from tormagd.physics.errors import DomainError
from tormagd.simulation.compiled_firmware import CompiledFirmware
from tormagd.simulation.device import DEFAULT_BAUD, FirmwareKind, VirtualDevice
from tormagd.simulation.faults import FORMS as KNOWN_FAULTS
from tormagd.simulation.faults import FaultError, parse_fault
from tormagd.simulation.firmware import Firmware
from tormagd.simulation.hand import KNOWN as KNOWN_HANDS
from tormagd.simulation.hand import HandError, parse_hand
from tormagd.simulation.parameters import PlantError, load_plant, plant_names
from tormagd.simulation.pty_door import PtyDoor

# The C sources are what a microcontroller would run; the Python twin, held equal to them by tests, needs no compiler.
FIRMWARES: dict[str, FirmwareKind] = {"python": Firmware, "c": CompiledFirmware}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the device until SIGTERM or SIGINT; the first line on stdout says where. Usage errors exit with 2."""
    parser = _parser()
    options = parser.parse_args(arguments)
    stopping = False

    def stop(_signal: int, _frame: object) -> None:
        nonlocal stopping
        stopping = True

    try:
        device = VirtualDevice(
            load_plant(options.plant),
            parse_hand(options.hand),
            [parse_fault(spec) for spec in options.fault],
            options.seed,
            options.baud,
            FIRMWARES[options.firmware],
        )
    except (PlantError, HandError, FaultError, DomainError, BuildError) as error:
        return _refuse(parser, error)
    with contextlib.ExitStack() as resources:
        try:
            truth = options.truth and resources.enter_context(options.truth.open("w", encoding="utf-8"))
        except OSError as error:
            return _refuse(parser, error)
        door = resources.enter_context(contextlib.closing(PtyDoor(device)))
        signal.signal(signal.SIGTERM, stop)
        signal.signal(signal.SIGINT, stop)
        print(door.path, flush=True)
        punctuality = door.serve(lambda: stopping, truth)
    if punctuality.late:
        print(
            f"fell behind real time {punctuality.late} times, by {punctuality.worst_s * 1e3:.1f} ms at worst; "
            f"stood still for {punctuality.slipped_s * 1e3:.0f} ms in all",
            file=sys.stderr,
        )
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tormagd.simulation", description="A simulated TorMag device.")
    doors = parser.add_mutually_exclusive_group(required=True)
    doors.add_argument("--pty", action="store_true", help="serial line on a pseudo-terminal, its path printed first")
    parser.add_argument("--plant", default="sample_1", metavar="FILE", help=f"TOML file, or {', '.join(plant_names())}")
    parser.add_argument("--hand", default="steady", metavar="SPEC", help=KNOWN_HANDS)
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="SPEC",
        help=f"may be repeated; {KNOWN_FAULTS}".replace("%", "%%"),
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of noise and jitter")
    parser.add_argument("--baud", type=_baud, default=DEFAULT_BAUD, metavar="N", help=f"default {DEFAULT_BAUD}")
    parser.add_argument(
        "--firmware",
        choices=FIRMWARES,
        default="python",
        help="c compiles and runs the firmware's own C sources; default python, which needs no compiler",
    )
    parser.add_argument("--truth", type=Path, metavar="FILE.csv", help="record what no sensor sees, 1000 rows a second")
    return parser


def _baud(text: str) -> int:
    baud = int(text)
    if not 1200 <= baud <= 20_000_000:
        raise argparse.ArgumentTypeError(f"{baud}: allowed are 1200 to 20000000")
    return baud


def _refuse(parser: argparse.ArgumentParser, error: Exception) -> NoReturn:
    parser.error(str(error))


if __name__ == "__main__":
    sys.exit(main())
