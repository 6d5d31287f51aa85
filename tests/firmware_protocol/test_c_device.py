"""The device's safety logic in C and its Python twin do the same, step by step, to the last bit."""

import copy
import random
from collections.abc import Callable, Iterator

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
    Switches,
    decode,
    encode,
)
from firmware_protocol.framing import FrameDecoder, encode_frame
from tormagd.simulation.compiled_firmware import CompiledFirmware
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.faults import parse_fault
from tormagd.simulation.firmware import TICK_S, Answer, Firmware, Output, Sensors
from tormagd.simulation.hand import SteadyHand
from tormagd.simulation.parameters import load_plant

Exchange = Callable[[list[str]], list[str]]

PLANT = load_plant("sample_1")
MM_PER_COUNT = PLANT.screw.lead_mm / PLANT.electronics.encoder_counts_per_rev
HOME_MM, CLOSED_MM = 47.5, 22.25
FULL_SPEED_MM_S = 20.0
ANSWERS = {Answer.NONE: 0, Answer.IDENTITY: 1, Answer.MEASUREMENT: 2}

pytestmark = pytest.mark.usefixtures("library")


class Carriages:
    """Two carriages that follow the duties, crudely, and whatever is put wrong with them."""

    def __init__(self, left_mm: float, right_mm: float) -> None:
        self.positions_mm = [left_mm, right_mm]
        self.starts_mm = [left_mm, right_mm]
        self.supply_V = 12.0
        self.temperature_C = 25.0
        self.drift_mm_s = 0.0
        self.current_A: float | None = None
        self.held = False
        self.blind: int | None = None

    def move(self, output: Output, dt_s: float) -> None:
        for side, duty in enumerate((output.left_duty, output.right_duty)):
            speed_mm_s = 0.0 if self.held else FULL_SPEED_MM_S * duty * (output.enabled and self.supply_V > 0.0)
            position_mm = self.positions_mm[side] + (speed_mm_s + self.drift_mm_s) * dt_s
            self.positions_mm[side] = min(max(position_mm, CLOSED_MM - 0.25), HOME_MM + 0.5)

    def sensors(self, output: Output) -> Sensors:
        left_mm, right_mm = self.positions_mm
        switches = Switches(0)
        for position_mm, opened, closed in (
            (left_mm, Switches.LEFT_OPEN, Switches.LEFT_CLOSED),
            (right_mm, Switches.RIGHT_OPEN, Switches.RIGHT_CLOSED),
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


class Twins:
    """Both firmwares through the same life; every step compares all that can be seen of them.

    `requests` and `expected` retell it to the exchange program.
    """

    def __init__(self, left_mm: float = 46.8, right_mm: float = 46.5) -> None:
        self.python = Firmware(PLANT)
        self.compiled = CompiledFirmware(PLANT)
        self.carriages = Carriages(left_mm, right_mm)
        self.time_s = 0.0
        self.counter = 0
        self.nonce = 0
        self.seen: set[object] = set()
        parameters = (
            PLANT.screw.lead_mm,
            PLANT.assumed.overcurrent_A,
            MM_PER_COUNT,
            self.python._handle_mm_per_count,
            PLANT.assumed.retract_mm_s,
            PLANT.assumed.homing_mm_s,
            1,
        )
        self.requests = [f"device {' '.join(map(repr, parameters))}", "identity"]
        self.expected = ["-", f"8 {encode(self.python.identity()).hex()}"]
        assert self.compiled.identity() == self.python.identity()

    @property
    def sensors(self) -> Sensors:
        return self.carriages.sensors(self.python.output)

    def tick(self, count: int = 1, dt_s: float = TICK_S) -> None:
        for _ in range(count):
            self.time_s += dt_s
            self.carriages.move(self.python.output, dt_s)
            sensors = self.sensors
            status = self.python.tick(self.time_s, sensors)
            payload = encode(status) if status else b""
            compiled = self.compiled.tick(self.time_s, sensors)
            assert payload == (encode(compiled) if compiled else b"")
            self._compare(f"tick {self.time_s!r}", f"{len(payload)} {payload.hex() or '-'}", sensors)

    def send(self, message: Message) -> None:
        payload = encode(message)
        on_the_wire = decode(FUNCTION[type(message)], payload)
        sensors = self.sensors
        answer = self.python.receive(self.time_s, on_the_wire, sensors)
        assert self.compiled.receive(self.time_s, on_the_wire, sensors) is answer
        request = f"receive {self.time_s!r} {FUNCTION[type(message)]} {payload.hex()}"
        self._compare(request, f"{ANSWERS[answer]}", sensors)
        if answer is Answer.MEASUREMENT:
            self._measure()

    def _measure(self) -> None:
        payloads = b"".join(map(encode, self.python.measurement(self.time_s, self.sensors)))
        assert payloads == b"".join(map(encode, self.compiled.measurement(self.time_s, self.sensors)))
        self._compare(f"measure {self.time_s!r}", f"0 {payloads.hex()}", self.sensors)

    def _compare(self, request: str, answer: str, sensors: Sensors) -> None:
        python, compiled = self.python, self.compiled
        view = (python.mode, python.faults, python.homed, python.output)
        assert (compiled.mode, compiled.faults, compiled.homed, compiled.output) == view
        assert encode(compiled.status(sensors)) == encode(python.status(sensors))
        self.seen |= {python.mode, *python.faults}
        output = python.output
        seen = [getattr(sensors, name) for name in Sensors.__match_args__]
        self.requests.append(" ".join([request, *(repr(+value) for value in seen)]))
        self.expected.append(
            f"{answer} {int(python.mode)} {int(python.faults)} {int(python.homed)} "
            f"{output.left_duty.hex()} {output.right_duty.hex()} {int(output.enabled)}"
        )

    # -- what a host and the world do ------------------------------------------------------------------------------

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
        for _ in range(100):
            self.drive(0.0, 0.0, DriveMode.OFF, 50)
            if self.python.mode is not DeviceMode.HOMING:
                break

    def settle(self) -> None:
        """Mend everything, wait until the drives are off, and clear."""
        carriages = self.carriages
        carriages.supply_V, carriages.temperature_C, carriages.current_A = 12.0, 25.0, None
        carriages.drift_mm_s, carriages.held, carriages.blind = 0.0, False, None
        self.tick(20)
        for _ in range(100):
            if self.python.mode in (DeviceMode.IDLE, DeviceMode.LATCHED):
                break
            self.tick(100)
        self.hello()
        self.command(Clear)


def stop_encoder(twins: Twins) -> None:
    twins.carriages.blind = twins.sensors.left_counts


def life(twins: Twins, generator: random.Random) -> Iterator[str]:
    """One random thing after the other, by name, each met in the state that the one before has left."""
    carriages = twins.carriages

    def duty() -> float:
        return generator.choice((-1.0, 1.0, 0.0, generator.uniform(-1.0, 1.0)))

    happenings: dict[str, Callable[[], object]] = {
        "run": lambda: twins.drive(duty(), duty(), count=generator.randrange(1, 120)),
        "close": lambda: twins.drive(-0.9, -0.9, count=generator.randrange(1, 400)),
        "let go": lambda: twins.drive(0.0, 0.0, DriveMode.OFF, generator.randrange(1, 60)),
        "same counter": lambda: [twins.send(Drive(0.5, 0.5, DriveMode.RUN, twins.counter)), twins.tick(8)],
        "silence": lambda: twins.tick(generator.choice((1, 49, 50, 51, 52, 300))),
        "a late tick": lambda: twins.tick(1, generator.uniform(0.0, 0.3)),
        "retract": lambda: twins.command(Retract),
        "clear": lambda: twins.command(Clear),
        "command": lambda: twins.command(Home),
        "repetition": lambda: twins.send(generator.choice((Retract, Home, Clear))(twins.nonce)),
        "home": twins.home,
        "settle": twins.settle,
        "settle and home": lambda: [twins.settle(), twins.home()],
        "foreign hello": lambda: twins.hello(SCHEMA_HASH ^ 1, generator.choice((PROTOCOL_VERSION, 9))),
        "foreign version": lambda: twins.hello(SCHEMA_HASH, PROTOCOL_VERSION + 1),
        "a device's message": lambda: twins.send(State(1.0, 1.0, 0.1, 3)),
        "supply": lambda: setattr(carriages, "supply_V", generator.choice((0.0, 8.96, 9.0, 15.0, 15.04))),
        "heat": lambda: setattr(carriages, "temperature_C", generator.choice((59.6, 60.0, 60.4, -40.0))),
        "drift": lambda: setattr(carriages, "drift_mm_s", generator.choice((-30.0, -3.0, 0.0, 3.0))),
        "current": lambda: setattr(carriages, "current_A", generator.choice((None, 0.0, 0.02, 0.025, 2.9, 3.1, -4.0))),
        "hold": lambda: setattr(carriages, "held", not carriages.held),
        "encoder": lambda: stop_encoder(twins),
    }
    while True:
        name = generator.choice(list(happenings))
        happenings[name]()
        yield name


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.randoms(use_true_random=False),
    left_mm=st.floats(45.0, 48.0),
    skew_mm=st.floats(-1.0, 1.0),
    happenings=st.integers(1, 25),
)
def test_twins_agree_step_by_step_whatever_happens(
    seed: random.Random, left_mm: float, skew_mm: float, happenings: int
) -> None:
    twins = Twins(left_mm, left_mm + skew_mm)
    for _, _name in zip(range(happenings), life(twins, seed), strict=False):
        pass


@settings(max_examples=15, deadline=None)
@given(
    steps=st.lists(
        st.tuples(
            st.sampled_from(["tick", "home", "retract", "clear", "run", "off", "hello"]),
            st.floats(0.0, 1.0),
            st.builds(
                Sensors,
                left_counts=st.integers(-(2**31), 2**31 - 1),
                right_counts=st.integers(-(2**31), 2**31 - 1),
                left_current_A=st.floats(-32.0, 32.0),
                right_current_A=st.floats(-32.0, 32.0),
                force_N=st.floats(-32.0, 32.0),
                handle_counts=st.integers(-(2**31), 2**31 - 1),
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
    python, compiled = Firmware(PLANT), CompiledFirmware(PLANT)
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
            ours, theirs = python.tick(time_s, sensors), compiled.tick(time_s, sensors)
            assert (ours and encode(ours)) == (theirs and encode(theirs))
        else:
            message = decode(FUNCTION[type(messages[what])], encode(messages[what]))
            assert python.receive(time_s, message, sensors) is compiled.receive(time_s, message, sensors)
        assert (python.mode, python.faults, python.homed) == (compiled.mode, compiled.faults, compiled.homed)
        assert python.output == compiled.output
        ours_measured = [encode(message) for message in python.measurement(time_s, sensors)]
        assert ours_measured == [encode(message) for message in compiled.measurement(time_s, sensors)]


def told_life() -> Twins:
    """One life that leads through every mode and every fault, then at random."""
    twins = Twins()
    carriages = twins.carriages

    def restart() -> None:
        twins.settle()
        twins.home()
        assert twins.python.homed, twins.python.faults

    twins.home()
    twins.drive(-0.5, -0.5, count=200)
    twins.tick(400)  # silence: COMMAND_TIMEOUT
    restart()
    twins.drive(0.0, -1.0, count=300)  # SKEW
    restart()
    carriages.positions_mm = [CLOSED_MM + 1.0, CLOSED_MM + 1.0]
    twins.drive(-1.0, -1.0, count=150)  # END_STOP
    restart()
    twins.drive(-1.0, -1.0, count=100)
    carriages.held, carriages.current_A = True, -3.5
    twins.drive(-1.0, -1.0, count=600)  # OVERCURRENT, then RETRACT_FAILED: a stall
    for current_A in (0.01, 0.025):  # RETRACT_FAILED: a motor without current; at a travelling one only after 8 s
        restart()
        twins.drive(-1.0, -1.0, count=50)
        carriages.held, carriages.current_A = True, current_A
        twins.command(Retract)
        twins.tick(8300)
    restart()
    twins.drive(-1.0, -1.0, count=50)
    carriages.held, carriages.current_A, carriages.drift_mm_s = True, 3.5, 0.18
    twins.command(Retract)
    twins.tick(700)  # creeping at a stalling current: 0.05 mm in 0.3 s is progress enough
    for drift_mm_s in (-5.0, 3.0):  # UNCOMMANDED_MOTION: inward, and outward from rest
        restart()
        twins.tick(150)
        carriages.drift_mm_s = drift_mm_s
        twins.tick(300)
    restart()
    for supply_V in (0.0, 15.04):  # SUPPLY
        carriages.supply_V = supply_V
        twins.tick(30)
        restart()
    twins.command(Home)
    twins.tick(5)
    twins.command(Clear)  # not while the motors are on
    assert twins.python.mode is DeviceMode.HOMING
    restart()
    carriages.temperature_C = 61.0
    twins.drive(-0.2, -0.2, count=30)  # TEMPERATURE
    twins.settle()
    twins.hello(SCHEMA_HASH ^ 1)  # SCHEMA_MISMATCH
    twins.settle()
    stop_encoder(twins)
    twins.home()  # HOMING_FAILED
    restart()
    twins.drive(-0.7, -0.7, count=100)
    twins.command(Retract)
    twins.drive(-0.7, -0.7, count=1200)  # not obeyed before it has let go
    assert twins.python.mode is DeviceMode.IDLE
    for _, _name in zip(range(60), life(twins, random.Random(20240515)), strict=False):
        pass
    return twins


@pytest.fixture(scope="module")
def told() -> Twins:
    return told_life()


def test_one_life_leads_through_every_mode_and_fault(told: Twins) -> None:
    assert told.seen == {*DeviceMode, *DeviceFault}


def test_under_sanitizers_the_same_life_gives_the_same_answers(told: Twins, exchange: Exchange) -> None:
    def duties_as_python_writes_them(answer: str) -> str:
        *rest, left, right, enabled = answer.split(" ")
        return " ".join([*rest, float.fromhex(left).hex(), float.fromhex(right).hex(), enabled])

    answers = exchange(told.requests)
    assert answers[:2] == told.expected[:2]
    assert [duties_as_python_writes_them(answer) for answer in answers[2:]] == told.expected[2:]


def test_a_copy_goes_its_own_way() -> None:
    twins = Twins()
    twins.home()
    before = twins.compiled.status(twins.sensors)
    other = copy.deepcopy(twins.compiled)
    other.receive(twins.time_s, Drive(-0.5, -0.5, DriveMode.RUN, (twins.counter + 1) % 256), twins.sensors)
    assert other.mode is DeviceMode.RUN
    assert twins.compiled.status(twins.sensors) == before


@pytest.mark.parametrize(
    ("name", "value"),
    [("supply_V", 25.6), ("temperature_C", 128.0), ("temperature_C", float("nan"))],
)
def test_a_status_that_does_not_fit_its_signals_is_not_sent(name: str, value: float) -> None:
    sensors = Twins().sensors.replaced(**{name: value})
    with pytest.raises(EncodeError):
        CompiledFirmware(PLANT).status(sensors)
    with pytest.raises(EncodeError):
        encode(Firmware(PLANT).status(sensors))


@pytest.mark.parametrize(
    ("name", "value"),
    [("left_current_A", 32.8), ("right_current_A", -33.0), ("force_N", float("inf")), ("force_N", float("nan"))],
)
def test_a_measurement_that_does_not_fit_its_signals_is_not_sent(name: str, value: float) -> None:
    sensors = Twins().sensors.replaced(**{name: value})
    with pytest.raises(EncodeError):
        CompiledFirmware(PLANT).measurement(0.1, sensors)
    with pytest.raises(EncodeError):
        encode(Firmware(PLANT).measurement(0.1, sensors)[1])


@pytest.mark.parametrize("counts", [32767, 32768, -32768, -32769, 65535, 2**31 - 1, -(2**31)])
def test_positions_run_over_at_the_same_count(counts: int) -> None:
    sensors = Twins().sensors.replaced(left_counts=counts, right_counts=counts - 1, handle_counts=counts)
    for time_s in (0.655354, 0.655356, 86400.0):
        ours = [encode(message) for message in Firmware(PLANT).measurement(time_s, sensors)]
        assert ours == [encode(message) for message in CompiledFirmware(PLANT).measurement(time_s, sensors)]


def test_a_new_host_starts_from_the_nonce_of_its_hello() -> None:
    twins = Twins()
    twins.send(Retract(5))
    assert twins.compiled.status(twins.sensors).command_nonce == 5
    twins.tick(2000)
    twins.send(Hello(SCHEMA_HASH, PROTOCOL_VERSION, 4))
    assert twins.compiled.status(twins.sensors).command_nonce == 4
    twins.send(Home(5))
    assert twins.compiled.mode is DeviceMode.HOMING


def duty(tick: int, position_mm: float) -> float:
    """What brings a carriage to -15 mm, then to -5."""
    return min(max(2.0 * ((-15.0 if tick < 4500 else -5.0) - position_mm), -1.0), 1.0)


@pytest.mark.parametrize(
    ("plant", "faults", "ticks", "latched"),
    [
        ("sample_2", ["drag_left=+50%@2.2", "encoder_stuck_left@4"], 6_000, DeviceFault.SKEW),
        ("sample_1", ["motor_reversed_left"], 1_500, DeviceFault.HOMING_FAILED),
        ("sample_1", ["encoder_reversed_left"], 1_500, DeviceFault.HOMING_FAILED),
    ],
)
def test_the_simulated_device_says_the_same_with_either_firmware(
    plant: str, faults: list[str], ticks: int, latched: DeviceFault
) -> None:
    """From homing, over a run where it comes to that, to a latch: all that it sends over its serial line."""
    said = []
    for boot in (Firmware, CompiledFirmware):
        device = VirtualDevice(load_plant(plant), SteadyHand(), [parse_fault(fault) for fault in faults], 5, boot=boot)
        decoder, sent, position_mm = FrameDecoder(), b"", 0.0
        for tick in range(ticks):
            messages: list[Message] = [Drive(0.0, 0.0, DriveMode.OFF, tick % 256)]
            if tick == 0:
                messages = [Hello(SCHEMA_HASH, PROTOCOL_VERSION, 0), Home(1)]
            elif tick > 3000:
                messages = [Drive(duty(tick, position_mm), duty(tick, position_mm), DriveMode.RUN, tick % 256)]
            for message in messages:
                device.receive(tick * 1e-3, encode_frame(FUNCTION[type(message)], tick % 256, encode(message)))
            data = device.transmit((tick + 1) * 1e-3)
            sent += data
            for frame in decoder.feed(data):
                if isinstance(received := decode(frame.function, frame.payload), State):
                    position_mm = received.left_position_mm
        assert latched in device.messages.firmware.faults
        said.append(sent)
    assert said[0] == said[1]
    functions = [frame.function for frame in FrameDecoder().feed(said[0])]
    assert functions.count(FUNCTION[Sense]) > 0.98 * ticks
