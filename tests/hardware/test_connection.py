"""The connection as a state machine, on a clock and a device that the test moves by hand."""

import itertools
from collections import deque

import msgspec
import pytest

from firmware_protocol.codec import (
    SCHEMA_HASH,
    Clear,
    DeviceFault,
    DeviceMode,
    Drive,
    DriveMode,
    Hello,
    Home,
    Identity,
    Message,
    Retract,
    Sense,
    State,
    Status,
    Switches,
    period,
)
from tormagd.config import Device
from tormagd.hardware.backend import BackendError
from tormagd.hardware.connection import FIRST_BACK_OFF_S, LONGEST_BACK_OFF_S, Connection
from tormagd.hardware.link import LinkState
from tormagd.hardware.measurement import DeviceRequest
from tormagd.hardware.streams import FrameStream
from tormagd_client.messages import LinkReport

TICK_S = 1e-3
US, ANOTHER = Identity(SCHEMA_HASH, 1, 0, 7), Identity(0xBAD, 3, 1, 7)
REFUSED = f"is 00000bad (firmware 3.1), this daemon's is {SCHEMA_HASH:08x}"
OPENING = {
    "gone": ("/dev/tormag: there is no such port", "plug the device in"),
    "held": ("/dev/tormag: another process holds it", "tormagctl ports says who"),
}
SENDING = {
    "gone": ("/dev/tormag: writing failed",),
    "bus-off": ("can0: bus-off", "look at the termination"),
}
COMMANDS = {Home: DeviceRequest.HOME, Retract: DeviceRequest.RETRACT, Clear: DeviceRequest.CLEAR}


class Firmware:
    """As much of a device as a connection can see."""

    def __init__(self) -> None:
        self.accepted: list[type[Message]] = []
        self.reset()

    def reset(self) -> None:
        self.nonce, self.counter, self.boot_ms, self.drive_counter = 0, 0, 0, 0

    def answers(self, message: Message, identity: Identity) -> list[Message]:
        if isinstance(message, Hello):
            self.nonce = message.nonce
            return [identity]
        if isinstance(message, Drive):
            self.counter = (self.counter + 1) % 256
            self.drive_counter = message.counter
            time_s = self.boot_ms * 1e-3 % period(State, "device_time_s")
            return [State(-1.0, -1.0, time_s, self.counter), Sense(0.1, 0.1, 1.0, 0.0)]
        if isinstance(message, Home | Retract | Clear) and message.nonce != self.nonce:
            self.nonce = message.nonce
            self.accepted.append(type(message))
        return []

    def status(self) -> Status:
        return Status(DeviceMode.IDLE, Switches.HOMED, DeviceFault(0), 23.0, 12.0, self.drive_counter, self.nonce)


class Port:
    def __init__(self, bench: "Bench") -> None:
        self.bench = bench
        self.waiting: deque[Message] = deque()
        self.stream = FrameStream()
        self.is_closed = False

    def receive(self) -> list[Message]:
        assert not self.is_closed
        if "gone" in self.bench.trouble:
            raise BackendError("/dev/tormag: the device was unplugged")
        messages, self.waiting = list(self.waiting), deque()
        self.stream.statistics.frames += len(messages)
        return messages

    def send(self, message: Message) -> None:
        assert not self.is_closed
        bench = self.bench
        if isinstance(message, Drive):
            assert bench.connection.state is LinkState.RUNNING, "only a device that is known is driven"
        if isinstance(message, Home | Clear):
            assert COMMANDS[type(message)] is bench.request
            assert bench.asked_of == bench.losses, "a command that the last device was given moves no other"
        for trouble in bench.trouble & SENDING.keys():
            raise BackendError(*SENDING[trouble])
        bench.sent.append(type(message))
        if "mute" not in bench.trouble:
            self.waiting.extend(bench.firmware.answers(message, ANOTHER if "another" in bench.trouble else US))

    def close(self) -> None:
        assert not self.is_closed
        self.is_closed = True


class Bench:
    def __init__(self) -> None:
        self.ms = 0
        self.firmware = Firmware()
        self.ports: list[Port] = []
        self.sent: list[type[Message]] = []
        self.attempts_s: list[float] = []
        self.losses, self.is_armed = 0, True
        self.trouble: set[str] = set()
        self.request, self.number = DeviceRequest.NONE, 0
        self.asked_of: int | None = None
        self.connection = Connection(Device(port="/dev/tormag"), self._open, self._lose, self._host)

    @property
    def now_s(self) -> float:
        return 1_000.0 + self.ms * TICK_S

    @property
    def port(self) -> Port | None:
        return self.ports[-1] if self.ports and not self.ports[-1].is_closed else None

    # what the connection is given
    def _open(self) -> Port:
        self.attempts_s.append(self.now_s)
        for trouble in self.trouble & OPENING.keys():
            raise BackendError(*OPENING[trouble])
        self.ports.append(Port(self))
        return self.ports[-1]

    def _lose(self) -> None:
        self.losses += 1
        if self.is_armed:
            self.ask(DeviceRequest.RETRACT)  # the core latches, and wants the gap open

    def _host(self, _now_s: float) -> str:
        return "this host slept" if "slept" in self.trouble else ""

    # what happens
    def ask(self, request: DeviceRequest) -> None:
        self.request, self.number = request, self.number + 1
        self.asked_of = self.losses if self.connection.state is LinkState.RUNNING else None

    def pass_ms(self, ms: int, is_stalled: bool = False) -> None:
        """Let time pass; a stalled host does not notice it."""
        for _ in range(ms):
            self.ms += 1
            self.firmware.boot_ms += 1
            if (port := self.port) is not None:
                if "babble" in self.trouble:
                    port.stream.statistics.corrupt += 1
                elif self.ms % 20 == 0 and not self.trouble & {"mute", "no Status", "gone"}:
                    port.waiting.append(self.firmware.status())
            if not is_stalled:
                self.beat()

    def beat(self) -> None:
        self.connection.receive(self.now_s)
        self.look()
        self.connection.exchange(self.now_s, 0.0, 0.0, DriveMode.OFF, self.request, self.number)
        self.look()

    def look(self) -> None:
        connection, still_open = self.connection, [port for port in self.ports if not port.is_closed]
        assert len(still_open) == (connection.state not in (LinkState.CLOSED, LinkState.BACK_OFF, LinkState.LOST))
        assert bool(connection.cause) == (connection.measurement is None)

    def running(self) -> "Bench":
        self.connection.open(self.now_s)
        self.pass_ms(100)
        assert self.connection.state is LinkState.RUNNING
        assert self.connection.measurement is not None
        return self


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.mark.parametrize(
    ("is_running", "trouble", "after_ms", "state", "cause", "remedy"),
    [
        (False, {"gone"}, 1, LinkState.BACK_OFF, "no such port", "plug"),
        (False, {"held"}, 1, LinkState.BACK_OFF, "another process", "tormagctl ports"),
        (False, {"no Status"}, 100, LinkState.RUNNING, "no Status yet", "wait a moment"),
        (False, {"another"}, 60, LinkState.REFUSED, REFUSED, "same protocol schema"),
        (True, {"another"}, 1_100, LinkState.REFUSED, REFUSED, "same protocol schema"),
        (False, {"mute"}, 1_010, LinkState.UNANSWERED, "it is silent", "rate"),
        (False, {"mute", "babble"}, 1_010, LinkState.UNANSWERED, "not this protocol", "rate"),
        (True, {"gone"}, 1, LinkState.LOST, "unplugged", "cable"),
        (True, {"mute"}, 82, LinkState.LOST, "no message for 80 ms", "cable"),
        (True, {"mute", "slept"}, 82, LinkState.LOST, "80 ms; this host slept", "doctor"),
        (True, {"bus-off"}, 1, LinkState.LOST, "bus-off", "termination"),
    ],
)
def test_each_trouble_has_its_state_cause_and_remedy_and_goes_when_it_is_mended(
    bench: Bench, is_running: bool, trouble: set[str], after_ms: int, state: LinkState, cause: str, remedy: str
) -> None:
    if is_running:
        bench.running()
    bench.trouble |= trouble
    if not is_running:
        bench.connection.open(bench.now_s)
    bench.pass_ms(after_ms)
    report = bench.connection.report()
    assert (report.state, bench.connection.state, bench.connection.measurement) == (str(state), state, None)
    assert cause in report.cause
    assert remedy in report.remedy
    bench.pass_ms(3_000)  # it has given up asking often by now
    bench.trouble.clear()
    bench.pass_ms(1_200)
    assert (bench.connection.state, bench.connection.cause, bench.connection.remedy) == (LinkState.RUNNING, "", "")
    assert bench.connection.measurement is not None


def test_a_device_that_was_reset_is_a_loss_without_closing_the_port(bench: Bench) -> None:
    bench.running()
    bench.firmware.reset()
    bench.pass_ms(60)
    assert bench.connection.state is LinkState.RUNNING
    assert (bench.losses, bench.connection.losses, len(bench.ports)) == (1, 1, 1)
    assert "reset" in bench.connection.report().last_loss


def test_a_host_that_was_not_run_does_not_take_its_own_sleep_for_the_devices(bench: Bench) -> None:
    bench.running().pass_ms(500, is_stalled=True)
    bench.ms += 1
    bench.beat()
    assert (bench.connection.state, bench.losses) == (LinkState.RUNNING, 0)


def test_waiting_grows_to_a_second_and_starts_anew_with_the_next_device(bench: Bench) -> None:
    bench.running().trouble.add("gone")
    first = len(bench.attempts_s)
    bench.pass_ms(6_000)
    waits_s = [after - before for before, after in itertools.pairwise(bench.attempts_s[first:])]
    assert waits_s[:4] == pytest.approx([0.1, 0.2, 0.4, 0.8], abs=2e-3)
    assert waits_s[4:] == pytest.approx([LONGEST_BACK_OFF_S] * len(waits_s[4:]), abs=2e-3)
    bench.trouble.clear()
    bench.pass_ms(1_100)
    lost_s = bench.now_s
    bench.trouble.add("gone")
    bench.pass_ms(60)
    assert bench.attempts_s[-1] - lost_s == pytest.approx(FIRST_BACK_OFF_S, abs=2e-3)


def test_opening_the_gap_waits_for_a_device_that_went_before_it_had_heard(bench: Bench) -> None:
    bench.running()
    bench.is_armed, bench.trouble = False, {"mute"}
    bench.ask(DeviceRequest.RETRACT)
    bench.pass_ms(20)
    assert Retract in bench.sent
    bench.pass_ms(3_000)
    bench.trouble.clear()
    bench.pass_ms(1_200)
    assert bench.firmware.accepted == [Retract]


@pytest.mark.parametrize(("request_", "kind"), [(DeviceRequest.HOME, Home), (DeviceRequest.CLEAR, Clear)])
def test_a_command_is_for_the_device_that_runs_when_it_is_given(
    bench: Bench, request_: DeviceRequest, kind: type[Message]
) -> None:
    bench.running().ask(request_)
    bench.pass_ms(40)
    assert bench.firmware.accepted == [kind]
    bench.is_armed, bench.trouble = False, {"mute"}
    bench.pass_ms(200)
    bench.ask(request_)
    bench.pass_ms(20)
    bench.trouble.clear()
    bench.pass_ms(1_200)
    assert (bench.connection.state, bench.firmware.accepted) == (LinkState.RUNNING, [kind])


def test_a_closed_connection_stays_closed(bench: Bench) -> None:
    bench.running().connection.close()
    bench.pass_ms(3_000)
    assert (bench.connection.state, len(bench.ports)) == (LinkState.CLOSED, 1)
    bench.connection.close()


def test_what_is_not_known_is_reported_as_such(bench: Bench) -> None:
    before = bench.connection.report()
    assert (before.state, before.frames, before.round_trip_us, before.clock) == ("CLOSED", None, None, None)
    bench.running().pass_ms(4_000)
    after = bench.connection.report()
    for report in (before, after):
        assert msgspec.msgpack.decode(msgspec.msgpack.encode(report), type=LinkReport) == report, "it travels"
    assert (after.firmware, after.serial_number, after.daemon_schema) == ("1.0", 7, f"{SCHEMA_HASH:08x}")
    assert after.round_trip_us.p50 == pytest.approx(1_000.0)
    assert (after.clock.offset_s, after.clock.drift_ppm) == pytest.approx((1_000.0005, 0.0), abs=1e-4)
