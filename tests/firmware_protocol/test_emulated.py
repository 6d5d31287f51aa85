"""The firmware's program for a Cortex-M4, run by QEMU, does the same as on this computer, to the bit."""

import json
import shutil
from pathlib import Path

import msgspec
import pytest

import firmware_protocol
from firmware_protocol.c.build import DEBIAN
from firmware_protocol.codec import (
    FUNCTION,
    SCHEMA_HASH,
    Clear,
    DeviceMode,
    Drive,
    DriveMode,
    Hello,
    Home,
    Message,
    Retract,
    Switches,
    encode,
)
from firmware_protocol.framing import encode_frame
from tormagd.simulation.__main__ import main as simulate
from tormagd.simulation.compiled_firmware import CompiledFirmware
from tormagd.simulation.device import FirmwareKind, VirtualDevice
from tormagd.simulation.emulated_firmware import CYCLES_PER_S, EmulatedFirmware, EmulationError
from tormagd.simulation.faults import parse_fault
from tormagd.simulation.firmware import Answer, Sensors
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

needs_packages = pytest.mark.skipif(
    any(shutil.which(tool) is None for tool in ("arm-none-eabi-gcc", "qemu-system-arm")),
    reason=f"needs the Debian packages {DEBIAN['qemu-system-arm']}",
)
PLANT = load_plant("sample_1")
AT_ONCE = msgspec.structs.replace(
    PLANT,
    firmware=msgspec.structs.replace(PLANT.firmware, reply_jitter_us=0.0),
    assumed=msgspec.structs.replace(PLANT.assumed, start_left_mm=47.4, start_right_mm=47.3),
)
"""Near home, and answered at once: the program measures when a Drive arrives."""
AT_REST = Sensors(0, 0, 0.0, 0.0, 0.1, 0, Switches.LEFT_OPEN | Switches.RIGHT_OPEN, 12.0, 25.0)
HELLO = Hello(SCHEMA_HASH, 1, 255)


class Timed(CompiledFirmware):
    """The host library with the clock and the tick of the board's timer."""

    def receive(self, time_s, message, sensors):
        return super().receive(round(time_s * CYCLES_PER_S) / CYCLES_PER_S, message, sensors)

    def tick(self, time_s, sensors):
        # a timer's first tick comes a millisecond after the reset
        return super().tick(round(time_s * CYCLES_PER_S) / CYCLES_PER_S, sensors) if time_s > 0.0 else None

    def measurement(self, time_s, sensors):
        return super().measurement(round(time_s * CYCLES_PER_S) / CYCLES_PER_S, sensors)


def life(boot: FirmwareKind) -> list[object]:
    device = VirtualDevice(AT_ONCE, SteadyHand(), [parse_fault("frozen@1.75")], boot=boot)
    commands: dict[int, Message] = {2: HELLO, 9: Home(1), 1690: Clear(2), 1721: Retract(3)}
    seen: list[object] = []
    modes: set[DeviceMode] = set()
    for ms in range(1, 1900):
        time_s = ms * 1e-3 + 3.3e-4
        if ms % 4 == 0 and not 1360 < ms < 1430:
            duty = -0.4 if ms < 1330 else 0.0
            drive = Drive(duty, duty, DriveMode.RUN if 1280 < ms < 1500 else DriveMode.OFF, ms // 4 % 256)
            device.receive(time_s, encode_frame(FUNCTION[Drive], ms % 256, encode(drive)))
        elif ms in commands:
            device.receive(time_s, encode_frame(FUNCTION[type(commands[ms])], ms % 256, encode(commands[ms])))
        firmware = device.messages.firmware
        modes.add(firmware.mode)
        seen.append((device.transmit(time_s), firmware.mode, firmware.faults, firmware.homed, firmware.output))
        seen.append(device.messages.truth)
    return [*seen, modes]


@needs_packages
def test_the_program_does_what_the_host_library_does_to_the_bit(library):
    expected = life(Timed)
    assert expected[-1] == set(DeviceMode)
    assert life(EmulatedFirmware) == expected


@needs_packages
def test_damaged_bytes_go_through_the_programs_own_decoder():
    vectors = json.loads((Path(firmware_protocol.__file__).parent / "vectors" / "frames.json").read_text())
    firmware = EmulatedFirmware(PLANT)
    try:
        for place, stream in enumerate(vectors["streams"], 1):
            firmware.hear(place * 1e-3, bytes.fromhex(stream["bytes"]) + b"\0", AT_REST)
            assert firmware.receive(place * 1e-3, HELLO, AT_REST) is Answer.IDENTITY
        assert firmware.instructions > 1000
    finally:
        used = firmware.close()
    assert used in range(100, 2000)
    assert firmware.close() is None


@needs_packages
def test_an_emulator_that_is_killed_is_said():
    firmware = EmulatedFirmware(PLANT)
    firmware._process.kill()
    with pytest.raises(EmulationError, match="the emulator has ended; its last words"):
        firmware.tick(1e-3, AT_REST)


def test_without_its_packages_one_sentence_names_them(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SystemExit, match="2"):
        simulate(["--pty", "--firmware", "qemu"])
    told = f"arm-none-eabi-gcc is not on the path; install the Debian packages {DEBIAN['arm-none-eabi-gcc']}"
    assert told in capsys.readouterr().err
