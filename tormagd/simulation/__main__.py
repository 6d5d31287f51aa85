"""`python -m tormagd.simulation`: the simulated device as a process of its own."""

import signal

if __name__ == "__main__" and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # the imports take half a second: until `main` takes over, Ctrl-C may end the process
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import argparse
import contextlib
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from firmware_protocol.c.build import BuildError
from tormagd.element.physics.errors import DomainError
from tormagd.ground.command_line import Within, add, option
from tormagd.ground.files import new_file
from tormagd.ground.scheduling import ask_for_fifo, ask_for_slices
from tormagd.ground.table import TableError
from tormagd.ground.terminal import interrupted_by, write_line
from tormagd.simulation.can_device import DEFAULT_BITRATE, DEFAULT_NODE, CanDevice
from tormagd.simulation.can_port import FOLDER_PREFIX, CanPort
from tormagd.simulation.compiled_firmware import CompiledFirmware
from tormagd.simulation.device import DEFAULT_BAUD, FirmwareKind, MessageDevice, VirtualDevice
from tormagd.simulation.emulated_firmware import EmulatedFirmware, EmulationError
from tormagd.simulation.faults import FORMS as KNOWN_FAULTS, FaultError, parse_fault
from tormagd.simulation.firmware import Firmware
from tormagd.simulation.hand import KNOWN as KNOWN_HANDS, HandError, parse_hand
from tormagd.simulation.parameters import PLANTS_INSERT, PlantError, load_plant, plant_names, with_insert
from tormagd.simulation.pty_port import PtyPort, SlcanPort
from tormagd.simulation.real_time import TRUTH_HEADER, Door, PacedDevice, serve
from tormagd_client.printable import printable

FIFO = 40
"A real device has a processor of its own: this is under a daemon's usual priority, and above all else."
# The C sources are what a microcontroller runs, in qemu or natively; the Python twin needs no compiler.
FIRMWARES: dict[str, FirmwareKind] = {"python": Firmware, "c": CompiledFirmware, "qemu": EmulatedFirmware}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the device until SIGTERM or SIGINT; the first line on stdout names its port or channel."""
    command = parser()
    options = command.parse_args(arguments)
    try:
        with contextlib.ExitStack() as resources:
            # before anything is opened, so that all of it is closed again
            is_stopped = resources.enter_context(interrupted_by(signal.SIGTERM, signal.SIGINT))
            try:
                device, door = _opened(options, resources)
                truth = options.truth and resources.enter_context(_begun(options.truth))
            except FileExistsError as error:
                command.error(printable(f"--truth {error.filename}: this exists; allowed is a new file"))
            except (PlantError, HandError, TableError, FaultError, DomainError, BuildError, OSError) as error:
                command.error(printable(str(error)))
            if write_line(door.address, sys.stdout) is not None:
                print(f"{command.prog}: {door.address} could not be written to stdout; it ends", file=sys.stderr)
                return 1
            if os.sched_getscheduler(0) == os.SCHED_OTHER:
                ask_for_slices()
                ask_for_fifo(FIFO)
            punctuality = serve(device, door, is_stopped, truth)
    except (EmulationError, OSError) as error:  # such as a full disk under the truth
        print(f"{command.prog}: {printable(str(error))}", file=sys.stderr)
        return 1
    if punctuality.late:
        print(
            f"fell behind real time {punctuality.late} times, by {punctuality.worst_s * 1e3:.1f} ms at worst; "
            f"stood still for {punctuality.slipped_s * 1e3:.0f} ms in all",
            file=sys.stderr,
        )
    return 0


def _begun(truth: Path) -> TextIO:
    with new_file(truth):
        truth.write_text(TRUTH_HEADER, encoding="utf-8")
    return truth.open("a", encoding="utf-8")


def _opened(options: argparse.Namespace, resources: contextlib.ExitStack) -> tuple[PacedDevice, Door]:
    """Build the device that the options ask for, and open its door."""
    boot = FIRMWARES[options.firmware]
    plant = with_insert(load_plant(options.plant), options.insert)
    hand = parse_hand(options.hand or ("steady" if plant.pad is None else "pressing"))
    faults = [parse_fault(spec) for spec in options.fault]
    door: Door
    if options.pty:
        line = VirtualDevice(plant, hand, faults, options.seed, options.baud, boot)
        door = resources.enter_context(contextlib.closing(PtyPort(line)))
        return line, door
    device = CanDevice(MessageDevice(plant, hand, faults, options.seed, boot), options.bitrate, options.node)
    if options.slcan:
        door = SlcanPort(device)
    else:
        folder = resources.enter_context(tempfile.TemporaryDirectory(prefix=FOLDER_PREFIX))
        door = CanPort(device, Path(options.can or f"{folder}/can"))
    resources.callback(door.close)
    return device, door


DOORS = (
    option("--pty", action="store_true", help="serial line on a pseudo-terminal; prints its path"),
    option("--slcan", action="store_true", help="CAN adapter on a pseudo-terminal; prints its path"),
    option(
        "--can",
        nargs="?",
        const="",
        metavar="PATH",
        help="CAN bus for python-can's interface tormagsim; prints its channel",
    ),
)
OPTIONS = (
    option("--plant", default="sample_1", metavar="FILE", help=f"TOML file, or {', '.join(plant_names())}"),
    option("--insert", default=PLANTS_INSERT, metavar="NAME", help=f"default {PLANTS_INSERT}; of a brake"),
    option("--hand", metavar="SPEC", help=f"{KNOWN_HANDS}; default steady, for a pad's plant pressing"),
    option(
        "--fault",
        action="append",
        default=[],
        metavar="SPEC",
        help=f"may be repeated; {KNOWN_FAULTS}".replace("%", "%%"),
    ),
    option("--seed", type=int, default=0, metavar="N", help="of noise and jitter"),
    option(
        "--baud",
        type=Within(1_200, 20_000_000, is_whole=True),
        default=DEFAULT_BAUD,
        metavar="N",
        help=f"default {DEFAULT_BAUD}",
    ),
    option(
        "--bitrate",
        type=Within(10_000, 1_000_000, is_whole=True),
        default=DEFAULT_BITRATE,
        metavar="N",
        help="of the CAN bus",
    ),
    option("--node", type=int, choices=range(16), default=DEFAULT_NODE, metavar="N", help="on the CAN bus"),
    option(
        "--firmware",
        choices=FIRMWARES,
        default="python",
        help="c: the firmware's C sources; qemu: the same on an emulated Cortex-M4; default python",
    ),
    option("--truth", type=Path, metavar="FILE.csv", help="new file: the true state, 1000 rows a second"),
)


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(prog="python -m tormagd.simulation", description="A simulated TorMag device.")
    add(made.add_mutually_exclusive_group(required=True), DOORS)
    add(made, OPTIONS)
    return made


if __name__ == "__main__":
    sys.exit(main())
