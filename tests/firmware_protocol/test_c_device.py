"""The device's safety logic in C and its Python twin do the same, step by step, to the last bit."""

import math
import random
from collections.abc import Callable, Iterator
from itertools import islice

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from firmware_protocol.codec import (
    FUNCTION,
    PROTOCOL_VERSION,
    SCHEMA_HASH,
    Clear,
    DeviceFault,
    DeviceMode,
    Drive,
    DriveMode,
    EncodeError,
    Hello,
    Home,
    Message,
    Retract,
    Sense,
    State,
    Status,
    Switches,
    decode,
    encode,
)
from tormagd.simulation.compiled_firmware import CompiledFirmware
from tormagd.simulation.firmware import TICK_S, Answer, Firmware, Output, Sensors
from tormagd.simulation.parameters import PlantParameters, load_plant

PLANT = load_plant("sample_1")
MM_PER_COUNT = PLANT.screw.lead_mm / PLANT.electronics.encoder_counts_per_rev
HOME_MM, CLOSED_MM = 47.5, 22.25
FULL_SPEED_MM_S = 20.0
ANSWERS = {Answer.NONE: 0, Answer.IDENTITY: 1, Answer.MEASUREMENT: 2}

pytestmark = pytest.mark.usefixtures("library")


class Carriages:
    def __init__(self, left_mm: float, right_mm: float) -> None:
        self.positions_mm = [left_mm, right_mm]
        self.starts_mm = [left_mm, right_mm]
        self.mend()

    def mend(self) -> None:
        self.supply_V, self.temperature_C, self.drift_mm_s, self.held = 12.0, 25.0, 0.0, False
        self.current_A: float | None = None
        self.blind: int | None = None

    def move(self, output: Output, dt_s: float) -> None:
        for side, duty in enumerate((output.left_duty, output.right_duty)):
            speed_mm_s = 0.0 if self.held else FULL_SPEED_MM_S * duty * (output.enabled and self.supply_V > 0.0)
            position_mm = self.positions_mm[side] + (speed_mm_s + self.drift_mm_s) * dt_s
            self.positions_mm[side] = min(max(position_mm, CLOSED_MM - 0.25), HOME_MM + 0.5)

    def sensors(self, output: Output) -> Sensors:
        switches = Switches(0)
        for position_mm, opened, closed in zip(
            self.positions_mm,
            (Switches.LEFT_OPEN, Switches.RIGHT_OPEN),
            (Switches.LEFT_CLOSED, Switches.RIGHT_CLOSED),
            strict=True,
        ):
            switches |= opened if position_mm >= HOME_MM else closed if position_mm <= CLOSED_MM else Switches(0)
        counts = [
            int((now - start) / MM_PER_COUNT) for now, start in zip(self.positions_mm, self.starts_mm, strict=True)
        ]
        return Sensors(
            left_counts=counts[0] if self.blind is None else self.blind,
            right_counts=counts[1],
            left_current_A=output.left_duty if self.current_A is None else self.current_A,
            right_current_A=output.right_duty if self.current_A is None else self.current_A,
            force_N=0.3 * counts[0] * MM_PER_COUNT,
            handle_counts=-7 * counts[1],
            switches=switches,
            supply_V=self.supply_V,
            temperature_C=self.temperature_C,
        )


class Twins(CompiledFirmware):
    """Both firmwares as one device's, checked to do the same."""

    def __init__(self, plant: PlantParameters = PLANT) -> None:
        super().__init__(plant)
        self.python = Firmware(plant)
        self.seen: set[object] = set()
        parameters = (
            plant.screw.lead_mm,
            plant.assumed.overcurrent_A,
            plant.screw.lead_mm / plant.electronics.encoder_counts_per_rev,
            self.python._handle_mm_per_count,
            plant.assumed.retract_mm_s,
            plant.assumed.homing_mm_s,
            1,
        )
        self.requests = [f"device {' '.join(map(repr, parameters))}", "identity"]
        self.expected = ["-", f"8 {encode(self.python.identity()).hex()}"]
        assert self.identity() == self.python.identity()

    def receive(self, time_s: float, message: Message, sensors: Sensors) -> Answer:
        payload = encode(message)
        message = decode(FUNCTION[type(message)], payload)
        answer = self.python.receive(time_s, message, sensors)
        assert super().receive(time_s, message, sensors) is answer
        self._compare(f"receive {time_s!r} {FUNCTION[type(message)]} {payload.hex()}", f"{ANSWERS[answer]}", sensors)
        return answer

    def tick(self, time_s: float, sensors: Sensors) -> Status | None:
        status = self.python.tick(time_s, sensors)
        payload = encode(status) if status else b""
        compiled = super().tick(time_s, sensors)
        assert payload == (encode(compiled) if compiled else b"")
        self._compare(f"tick {time_s!r}", f"{len(payload)} {payload.hex() or '-'}", sensors)
        return status

    def measurement(self, time_s: float, sensors: Sensors) -> tuple[State, Sense]:
        measured = super().measurement(time_s, sensors)
        payloads = b"".join(map(encode, measured))
        assert payloads == b"".join(map(encode, self.python.measurement(time_s, sensors)))
        self._compare(f"measure {time_s!r}", f"0 {payloads.hex()}", sensors)
        return measured

    def _compare(self, request: str, answer: str, sensors: Sensors) -> None:
        python, output, view = self.python, self.python.output, self.view
        assert (view.mode, view.faults, view.homed) == (python.mode, python.faults, python.homed)
        assert Output(view.left_duty, view.right_duty, view.enabled) == output
        assert encode(self.status(sensors)) == encode(python.status(sensors))
        self.seen |= {python.mode, *python.faults}
        seen = [getattr(sensors, name) for name in Sensors.__match_args__]
        self.requests.append(" ".join([request, *(repr(+value) for value in seen)]))
        self.expected.append(
            f"{answer} {int(python.mode)} {int(python.faults)} {int(python.homed)} "
            f"{output.left_duty.hex()} {output.right_duty.hex()} {int(output.enabled)}"
        )


class Bench:
    def __init__(self, left_mm: float = 46.8, right_mm: float = 46.5) -> None:
        self.twins = Twins()
        self.carriages = Carriages(left_mm, right_mm)
        self.time_s, self.counter, self.nonce = 0.0, 0, 0

    @property
    def sensors(self) -> Sensors:
        return self.carriages.sensors(self.twins.python.output)

    def tick(self, count: int = 1, dt_s: float = TICK_S) -> None:
        for _ in range(count):
            self.time_s += dt_s
            self.carriages.move(self.twins.python.output, dt_s)
            self.twins.tick(self.time_s, self.sensors)

    def send(self, message: Message) -> None:
        if self.twins.receive(self.time_s, message, self.sensors) is Answer.MEASUREMENT:
            self.twins.measurement(self.time_s, self.sensors)

    def drive(self, left: float, right: float, mode: DriveMode = DriveMode.RUN, count: int = 1) -> None:
        for _ in range(count):
            self.counter = (self.counter + 1) % 256
            self.send(Drive(left, right, mode, self.counter))
            self.tick()

    def command(self, kind: Callable[[int], Message]) -> None:
        self.nonce = self.nonce % 255 + 1
        self.send(kind(self.nonce))

    def hello(self, schema: int = SCHEMA_HASH, version: int = PROTOCOL_VERSION) -> None:
        self.send(Hello(schema, version, self.nonce))

    def home(self) -> None:
        self.hello()
        self.command(Home)
        for _ in range(500):
            self.drive(0.0, 0.0, DriveMode.OFF)
            self.tick(9)
            if self.twins.mode is not DeviceMode.HOMING:
                break

    def settle(self) -> None:
        self.carriages.mend()
        self.tick(20)
        for _ in range(100):
            if self.twins.mode in (DeviceMode.IDLE, DeviceMode.LATCHED):
                break
            self.tick(100)
        self.hello()
        self.command(Clear)

    def reach_the_end(self) -> None:
        self.settle()
        self.home()
        self.drive(0.0, 0.0)
        self.carriages.positions_mm = [CLOSED_MM + 1.0, CLOSED_MM + 1.0]
        self.drive(-1.0, -1.0, count=150)

    def open_stuck(self, current_A: float, drift_mm_s: float, ticks: int, tick_s: float) -> None:
        self.settle()
        self.home()
        self.drive(-1.0, -1.0, count=50)
        self.carriages.held, self.carriages.current_A, self.carriages.drift_mm_s = True, current_A, drift_mm_s
        self.command(Retract)
        self.tick(ticks, tick_s)

    def stop_encoder(self) -> None:
        self.carriages.blind = self.sensors.left_counts


STUCK = ((0.01, 0.0, 700, TICK_S), (0.025, 0.0, 830, 10.0 * TICK_S), (3.5, 0.18, 700, TICK_S))
"""A motor without current, at once; a travelling one only after 8 s; not a creeping one: 0.05 mm in 0.3 s is enough."""


def life(bench: Bench, generator: random.Random) -> Iterator[str]:
    """Do one random thing after the other, each in the state that the one before has left."""
    carriages = bench.carriages

    def duty() -> float:
        return generator.choice((-1.0, 1.0, 0.0, generator.uniform(-1.0, 1.0)))

    happenings: dict[str, Callable[[], object]] = {
        "run": lambda: bench.drive(duty(), duty(), count=generator.randrange(1, 120)),
        "close": lambda: bench.drive(-0.9, -0.9, count=generator.randrange(1, 400)),
        "let go": lambda: bench.drive(0.0, 0.0, DriveMode.OFF, generator.randrange(1, 60)),
        "same counter": lambda: [bench.send(Drive(0.5, 0.5, DriveMode.RUN, bench.counter)), bench.tick(8)],
        "silence": lambda: bench.tick(generator.choice((1, 49, 50, 51, 52, 300))),
        "a late tick": lambda: bench.tick(1, generator.uniform(0.0, 0.3)),
        "retract": lambda: bench.command(Retract),
        "clear": lambda: bench.command(Clear),
        "command": lambda: bench.command(Home),
        "repetition": lambda: bench.send(generator.choice((Retract, Home, Clear))(bench.nonce)),
        "home": bench.home,
        "settle": bench.settle,
        "settle and home": lambda: [bench.settle(), bench.home()],
        "foreign hello": lambda: bench.hello(SCHEMA_HASH ^ 1, generator.choice((PROTOCOL_VERSION, 9))),
        "foreign version": lambda: bench.hello(SCHEMA_HASH, PROTOCOL_VERSION + 1),
        "a device's message": lambda: bench.send(State(1.0, 1.0, 0.1, 3)),
        "supply": lambda: setattr(carriages, "supply_V", generator.choice((0.0, 8.96, 9.0, 15.0, 15.04))),
        "heat": lambda: setattr(carriages, "temperature_C", generator.choice((59.6, 60.0, 60.4, -40.0))),
        "drift": lambda: setattr(carriages, "drift_mm_s", generator.choice((-30.0, -3.0, 0.0, 3.0))),
        "current": lambda: setattr(carriages, "current_A", generator.choice((None, 0.0, 0.02, 0.025, 2.9, 3.1, -4.0))),
        "hold": lambda: setattr(carriages, "held", not carriages.held),
        "encoder": bench.stop_encoder,
        "blind": lambda: [bench.settle(), bench.stop_encoder(), bench.home()],
        "askew": lambda: [bench.settle(), bench.home(), bench.drive(0.0, -1.0, count=300)],
        "closed end": bench.reach_the_end,
        "stuck": lambda: bench.open_stuck(*generator.choice(STUCK)),
        "backwards": lambda: [bench.settle(), setattr(carriages, "drift_mm_s", -30.0), bench.home()],
    }
    while True:
        name = generator.choice(list(happenings))
        happenings[name]()
        yield name


@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.randoms(use_true_random=False),
    left_mm=st.floats(45.0, 48.0),
    skew_mm=st.floats(-1.0, 1.0),
    happenings=st.integers(1, 25),
)
def test_twins_agree_step_by_step_whatever_happens(
    seed: random.Random, left_mm: float, skew_mm: float, happenings: int
) -> None:
    list(islice(life(Bench(left_mm, left_mm + skew_mm), seed), happenings))


COUNTS = st.integers(-(2**31), 2**31 - 1) | st.sampled_from([32767, 32768, -32768, -32769, 65535])
"""Any, and those where positions overflow."""


@settings(max_examples=15, deadline=None)
@given(
    steps=st.lists(
        st.tuples(
            st.sampled_from(["tick", "home", "retract", "clear", "run", "off", "hello"]),
            st.floats(0.0, 1.0) | st.sampled_from([0.655354, 0.655356]),
            st.builds(
                Sensors,
                left_counts=COUNTS,
                right_counts=COUNTS,
                left_current_A=st.floats(-32.0, 32.0),
                right_current_A=st.floats(-32.0, 32.0),
                force_N=st.floats(-32.0, 32.0),
                handle_counts=COUNTS,
                switches=st.integers(0, 15).map(Switches),
                supply_V=st.floats(8.0, 16.0),
                temperature_C=st.floats(-100.0, 100.0),
            ),
        ),
        min_size=1,
        max_size=60,
    )
)
def test_twins_agree_on_sensors_that_no_device_could_have(steps: list[tuple[str, float, Sensors]]) -> None:
    twins = Twins()
    time_s = 0.0
    for number, (what, dt_s, sensors) in enumerate(steps):
        time_s += dt_s
        messages: dict[str, Message] = {
            "home": Home(number),
            "retract": Retract(number),
            "clear": Clear(number),
            "run": Drive(dt_s, -dt_s, DriveMode.RUN, number),
            "off": Drive(0.0, 0.0, DriveMode.OFF, number),
            "hello": Hello(SCHEMA_HASH, PROTOCOL_VERSION, number),
        }
        if what == "tick":
            twins.tick(time_s, sensors)
        else:
            twins.receive(time_s, messages[what], sensors)
        twins.measurement(time_s, sensors)


@pytest.fixture(scope="module")
def told() -> Twins:
    bench = Bench()
    list(islice(life(bench, random.Random(4)), 150))
    return bench.twins


def test_one_life_leads_through_every_mode_and_fault(told: Twins) -> None:
    assert told.seen == {*DeviceMode, *DeviceFault}


def test_under_sanitizers_the_same_life_gives_the_same_answers(told: Twins, exchange) -> None:
    def duties_as_python_writes_them(answer: str) -> str:
        *rest, left, right, enabled = answer.split(" ")
        return " ".join([*rest, float.fromhex(left).hex(), float.fromhex(right).hex(), enabled])

    answers = exchange(told.requests)
    assert answers[:2] == told.expected[:2]
    assert [duties_as_python_writes_them(answer) for answer in answers[2:]] == told.expected[2:]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("supply_V", 25.6),
        ("temperature_C", 128.0),
        ("temperature_C", math.nan),
        ("left_current_A", 32.8),
        ("right_current_A", -33.0),
        ("force_N", math.inf),
        ("force_N", math.nan),
    ],
)
def test_what_does_not_fit_its_signal_is_not_sent(name: str, value: float) -> None:
    sensors = Bench().sensors.replaced(**{name: value})
    for firmware in (Firmware(PLANT), CompiledFirmware(PLANT)):
        with pytest.raises(EncodeError):
            list(map(encode, (firmware.status(sensors), *firmware.measurement(0.1, sensors))))
