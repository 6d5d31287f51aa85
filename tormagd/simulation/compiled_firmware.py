"""The firmware's C sources, compiled for this machine, behind the interface of the Python firmware.

What a microcontroller would run runs here: every message goes through the C codec as payload bytes, and the state is
the C struct. Tests hold this firmware and the Python one equal step by step.
"""

import ctypes
import math
from functools import cache
from typing import TypeVar

from firmware_protocol.c.build import BuildError, load_library
from firmware_protocol.codec import (
    FUNCTION,
    DecodeError,
    DeviceFault,
    DeviceMode,
    EncodeError,
    Identity,
    Message,
    Sense,
    State,
    Status,
    decode,
    encode,
)
from tormagd.simulation.firmware import OFF, SERIAL_NUMBER, Answer, Output, Sensors
from tormagd.simulation.hand import ROLLER_RADIUS_MM
from tormagd.simulation.parameters import PlantParameters

MAX_PAYLOAD = 8
M = TypeVar("M", State, Sense, Status, Identity)
ANSWERS = (Answer.NONE, Answer.IDENTITY, Answer.MEASUREMENT)


class CParameters(ctypes.Structure):
    """struct tormag_device_parameters"""

    _fields_ = [
        ("lead_mm", ctypes.c_double),
        ("stall_A", ctypes.c_double),
        ("mm_per_count", ctypes.c_double),
        ("handle_mm_per_count", ctypes.c_double),
        ("retract_mm_s", ctypes.c_double),
        ("homing_mm_s", ctypes.c_double),
        ("serial_number", ctypes.c_uint16),
    ]


class CSensors(ctypes.Structure):
    """struct tormag_sensors, in the order of `Sensors`"""

    _fields_ = [
        ("left_counts", ctypes.c_int32),
        ("right_counts", ctypes.c_int32),
        ("left_current_A", ctypes.c_double),
        ("right_current_A", ctypes.c_double),
        ("force_N", ctypes.c_double),
        ("handle_counts", ctypes.c_int32),
        ("switches", ctypes.c_uint8),
        ("supply_V", ctypes.c_double),
        ("temperature_C", ctypes.c_double),
    ]


class View(ctypes.Structure):
    """struct tormag_bridge_view"""

    _fields_ = [
        ("mode", ctypes.c_uint8),
        ("faults", ctypes.c_uint16),
        ("homed", ctypes.c_bool),
        ("left_duty", ctypes.c_double),
        ("right_duty", ctypes.c_double),
        ("enabled", ctypes.c_bool),
    ]


@cache
def _library() -> ctypes.CDLL:
    library = load_library()
    pointer, time_s, payload = ctypes.c_void_p, ctypes.c_double, ctypes.c_char_p
    sensors = ctypes.POINTER(CSensors)
    library.tormag_device_init.argtypes = [pointer, pointer]
    for name, arguments in {
        "sizes": [pointer],
        "receive": [pointer, time_s, ctypes.c_uint8, payload, ctypes.c_size_t, sensors],
        "tick": [pointer, time_s, sensors, payload],
        "measurement": [pointer, time_s, sensors, payload],
        "status": [pointer, sensors, payload],
        "identity": [pointer, payload],
        "view": [pointer, pointer],
    }.items():
        getattr(library, f"tormag_bridge_{name}").argtypes = arguments
    _, *structures = _sizes(library)
    if structures != [ctypes.sizeof(structure) for structure in (CParameters, CSensors, View)]:
        raise BuildError("the C structures are not laid out as ctypes does it; use the Python firmware on this machine")
    return library


def _sizes(library: ctypes.CDLL) -> list[int]:
    sizes = (ctypes.c_size_t * 4)()
    library.tormag_bridge_sizes(sizes)
    return list(sizes)


class ViewedFirmware:
    """What `view` shows of a firmware in C, as `Firmware` shows it."""

    output: Output = OFF
    "The same object until it changes, so `is` tells whether it has."
    view = View()

    @property
    def mode(self) -> DeviceMode:
        return DeviceMode(self.view.mode)

    @property
    def faults(self) -> DeviceFault:
        return DeviceFault(self.view.faults)

    @property
    def homed(self) -> bool:
        return bool(self.view.homed)

    def show(self, view: View) -> None:
        output = Output(view.left_duty, view.right_duty, view.enabled)
        self.view, self.output = view, self.output if output == self.output else output


class CompiledFirmware(ViewedFirmware):
    """One device's firmware in C from its boot on, with the interface of `Firmware`."""

    def __init__(self, plant: PlantParameters) -> None:
        library = _library()
        # for alignment
        self._device = (ctypes.c_double * math.ceil(_sizes(library)[0] / ctypes.sizeof(ctypes.c_double)))()
        library.tormag_device_init(self._device, ctypes.byref(parameters_of(plant)))
        self._look()

    def receive(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        payload = encode(message)
        answer: int = _library().tormag_bridge_receive(
            self._device, time_s, FUNCTION[type(message)], payload, len(payload), seen(sensors)
        )
        self._look()
        if answer < 0:
            raise DecodeError(f"{message}: the C codec refuses {payload.hex()} with result {-answer}")
        return ANSWERS[answer]

    def tick(self, time_s: float, sensors: Sensors) -> Status | None:
        length, payload = self._report("tick", 1, time_s, seen(sensors))
        self._look()
        return _decoded(Status, payload) if length else None

    def status(self, sensors: Sensors) -> Status:
        _, payload = self._report("status", 1, seen(sensors))
        return _decoded(Status, payload)

    def measurement(self, time_s: float, sensors: Sensors) -> tuple[State, Sense]:
        _, payloads = self._report("measurement", 2, time_s, seen(sensors))
        return _decoded(State, payloads[:MAX_PAYLOAD]), _decoded(Sense, payloads[MAX_PAYLOAD:])

    def identity(self) -> Identity:
        _, payload = self._report("identity", 1)
        return _decoded(Identity, payload)

    def _report(self, name: str, messages: int, *arguments: float | CSensors) -> tuple[int, bytes]:
        """Return what a function of the bridge returns, and the payloads that it wrote."""
        payloads = ctypes.create_string_buffer(messages * MAX_PAYLOAD)
        result: int = getattr(_library(), f"tormag_bridge_{name}")(self._device, *arguments, payloads)
        if result < 0:
            raise EncodeError(f"{name} of {arguments}: a value has no step on the wire")
        return result, payloads.raw

    def _look(self) -> None:
        view = View()
        _library().tormag_bridge_view(self._device, ctypes.byref(view))
        self.show(view)


def parameters_of(plant: PlantParameters) -> CParameters:
    return CParameters(
        lead_mm=plant.screw.lead_mm,
        stall_A=plant.assumed.overcurrent_A,
        mm_per_count=plant.screw.lead_mm / plant.electronics.encoder_counts_per_rev,
        handle_mm_per_count=math.tau * ROLLER_RADIUS_MM / plant.assumed.handle_counts_per_rev,
        retract_mm_s=plant.assumed.retract_mm_s,
        homing_mm_s=plant.assumed.homing_mm_s,
        serial_number=SERIAL_NUMBER,
    )


def seen(sensors: Sensors) -> CSensors:
    return CSensors(
        sensors.left_counts,
        sensors.right_counts,
        sensors.left_current_A,
        sensors.right_current_A,
        sensors.force_N,
        sensors.handle_counts,
        sensors.switches,
        sensors.supply_V,
        sensors.temperature_C,
    )


def _decoded(kind: type[M], payload: bytes) -> M:
    message = decode(FUNCTION[kind], payload)
    assert isinstance(message, kind), f"function {FUNCTION[kind]} decodes to {kind}"
    return message
