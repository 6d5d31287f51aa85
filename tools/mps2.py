"""The firmware on an emulated Cortex-M4, in virtual time: its figures, and its pulse beside the host build's.

Instructions are those that QEMU has executed, to 40 in a wake. They are no cycles: a Cortex-M4 takes one or more for
each. The emulated UART takes any byte at once, so no baud rate is overrun.
"""

import argparse
import subprocess
import sys
from collections import defaultdict
from statistics import mean
from typing import final

import numpy as np
from judge.following import PULSE_N, RATE_HZ, Case, rehearse
from virtual_port import VirtualPort

from firmware_protocol.c.build import BuildError, Target, build, debian_tool
from firmware_protocol.conformance.check import run
from firmware_protocol.conformance.examination import CHECKS
from firmware_protocol.conformance.host import Host
from firmware_protocol.conformance.line import SerialLine
from tormag_lab.human_pulse import pulse_profile
from tormag_lab.told import table
from tormagd.config import Config
from tormagd.simulation.compiled_firmware import CompiledFirmware
from tormagd.simulation.device import FirmwareKind, VirtualDevice
from tormagd.simulation.emulated_firmware import EmulatedFirmware
from tormagd.simulation.firmware import Answer, Sensors
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import PlantParameters, load_plant

PULSE_S = 20.0
MAX_N = 1e-3
DRIVE = "Drive taken, State and Sense sent"


@final
class Counted(EmulatedFirmware):
    """The program; it adds the instructions of its wakes to `counts`, by purpose."""

    def __init__(self, plant: PlantParameters, counts: defaultdict[str, list[int]]) -> None:
        super().__init__(plant)
        self.counts, self.unanswered = counts, 0

    def hear(self, time_s: float, data: bytes, sensors: Sensors) -> Answer:
        answer = super().hear(time_s, data, sensors)
        if answer is Answer.MEASUREMENT:
            self.counts[DRIVE].append(self.instructions)
        self.unanswered += answer is Answer.NONE and data[1:2] == b"\2"
        return answer

    def tick(self, time_s: float, sensors: Sensors) -> object:  # type: ignore[override]
        status = super().tick(time_s, sensors)
        self.counts[f"tick in {self.mode.name}" + (", Status sent" if status else "")].append(self.instructions)
        return status


def main() -> int:
    """Print the figures; return 1 if the kit fails the program, a frame was dropped, or the pulses differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pulses", type=int, choices=range(1, 181), default=1, metavar="N", help="of 20 s each")
    parser.add_argument("--kit", action="store_true", help="the conformance kit's checks instead")
    options = parser.parse_args()
    try:
        program, size = build(Target.MPS2), debian_tool("arm-none-eabi-size")
    except BuildError as error:
        parser.error(str(error))
    booted: list[Counted] = []
    counts: defaultdict[str, list[int]] = defaultdict(list)

    def boot(plant: PlantParameters) -> EmulatedFirmware:
        booted.append(Counted(plant, counts))
        return booted[-1]

    is_right = is_passed(boot) if options.kit else is_followed(boot, options.pulses)
    listing = subprocess.run([size, program], capture_output=True, text=True, check=True).stdout
    text, data, bss = map(int, listing.splitlines()[1].split()[:3])
    dropped = sum(one.unanswered + one.statistics.lost + one.statistics.corrupt for one in booted)
    used = max(one.close() or 0 for one in booted)
    print(f"flash {text + data} bytes, RAM {data + bss} bytes, stack {used} bytes by paint")
    wakes = sorted(counts.items())
    means = [{"wake": name, "times": len(each), "mean": round(mean(each)), "most": max(each)} for name, each in wakes]
    print(*table(means), sep="\n")
    print(f"{len(counts[DRIVE])} Drives answered, {dropped} frames dropped, those that the kit damages among them")
    return int(not is_right or (dropped > 0 and not options.kit))


def is_passed(boot: FirmwareKind) -> bool:
    port = VirtualPort(VirtualDevice(load_plant("sample_1"), SteadyHand(), boot=boot))
    line, messages = SerialLine(port), port.device.messages
    host = Host(line, reset=lambda how: messages._reset(port.now_s()))
    results = []
    for result in run(host, CHECKS):
        results.append(result)
        print(f"{result.check.name}: {result.seen}", flush=True)
    failed = [result.check.name for result in results if result.passed is False]
    print(f"{len(results)} checks, {len(failed)} failed: {', '.join(failed) or 'none'}")
    return not failed


def is_followed(boot: FirmwareKind, pulses: int) -> bool:
    forces_N = np.tile(pulse_profile(PULSE_S, *PULSE_N, RATE_HZ)[1], pulses)
    times_s = np.arange(forces_N.size) / RATE_HZ
    there_N, here_N = (
        rehearse(Config(scene="pulse"), Case("sample 1"), times_s, forces_N, made).rendered_N
        for made in (boot, CompiledFirmware)
    )
    worst_N = float(np.abs(there_N - here_N).max())
    print(f"pulse of {times_s[-1]:.0f} s: {worst_N * 1e3:.2g} mN at most from the host library's")
    return worst_N <= MAX_N


if __name__ == "__main__":
    sys.exit(main())
