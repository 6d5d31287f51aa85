"""Several publishers at one daemon, over real sockets: each as a socket of its own, with a clock that is what it is.

Nothing here asserts a duration: a busy machine may be late, and no source may be locked out for that.
"""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgpack
import pytest
import zmq

from tormagd_client.messages import VERSION, Setpoint, encode

pytestmark = pytest.mark.live

PERIOD_S = 0.004
VALID_MS = 500.0
"Longer than the pauses of a busy machine."


class Publisher(threading.Thread):
    """Publishes a force steadily until it is told to end; `clock_s` is added to its stamps."""

    def __init__(self, folder: Any, source: str, force_N: float, **fields: Any) -> None:
        super().__init__(daemon=True)
        self.source, self.force_N, self.fields = source, force_N, fields
        self.seq, self.sent, self.clock_s = 0, 0, 0.0
        self._address = f"ipc://{folder}/setpoint"
        self._is_over = threading.Event()
        self._once: list[int] = []

    def run(self) -> None:
        context = zmq.Context()
        socket = context.socket(zmq.PUB)
        socket.linger = 0
        socket.connect(self._address)
        while not self._is_over.wait(PERIOD_S):
            numbers, self._once = [*self._once, self.seq], []
            for seq in numbers:
                setpoint = Setpoint(
                    v=VERSION,
                    source=self.source,
                    seq=seq,
                    stamp_ns=time.time_ns() + round(self.clock_s * 1e9),
                    servo_cf=self.force_N,
                    valid_for_ms=VALID_MS,
                    **self.fields,
                )
                socket.send(encode(setpoint))
            self.seq += 1
            self.sent += 1
        context.destroy(linger=0)

    def say_once(self, seq: int) -> None:
        """One message with this number, before the next."""
        self._once.append(seq)

    def end(self) -> None:
        self._is_over.set()
        self.join()


Publish = Callable[..., Publisher]


@pytest.fixture
def publish(rig) -> Iterator[Publish]:
    """Starts publishers at the daemon; they end with the test."""
    started: list[Publisher] = []

    def start(source: str, force_N: float, clock_s: float = 0.0, **fields: Any) -> Publisher:
        made = Publisher(rig.folder, source, force_N, **fields)
        made.clock_s = clock_s
        started.append(made)
        made.start()
        return made

    yield start
    for each in started:
        each.end()


# what is asked of `status` is of now; telemetry waits in the socket of whoever has not read it


def of(rig, source: str) -> dict[str, Any]:
    """What the daemon says of a source; empty before it was heard."""
    return rig.status()["setpoints"]["by_source"].get(source, {})


def holds(rig, source: str) -> bool:
    return of(rig, source).get("state") == "holds"


def test_a_second_publisher_is_refused_and_named_until_it_is_given_the_brake(rig, publish):
    rig.arm()
    publish("patient", 0.9)
    rig.until(lambda: abs((rig.telemetry().measured_cf or 0.0) - 0.9) < 0.06, "0.9 N")
    publish("console", 1.6)
    rig.until(lambda: "OTHER_SOURCE" in rig.telemetry().limits, "the other one is named")
    told = {each["code"]: each for each in rig.status()["limit_details"]}["OTHER_SOURCE"]
    assert told["cause"] == "'console' sends setpoints too, and 'patient' holds the brake"
    assert told["remedy"].endswith("tormagctl take console")
    assert {rig.status()["setpoint_cf"] for _ in range(25)} == {0.9}
    assert rig.command("take").error.code == "bad_source"
    assert rig.command("take", source="nobody").error.code == "unknown_source"
    assert rig.command("take", source="console").result == {"source": "console", "instead_of": "patient"}
    governed = []
    rig.until(lambda: governed.append(rig.telemetry().governed_cf) or governed[-1] == 1.6, "the ramp ends at 1.6 N")
    assert governed == sorted(governed)
    assert sum(0.9 < force_N < 1.6 for force_N in governed) >= 5
    assert of(rig, "patient")["state"] == "refused"


def test_the_second_takes_over_when_the_first_is_stale(rig, publish):
    first = publish("patient", 0.9)
    rig.until(lambda: holds(rig, "patient"), "the first holds the brake")
    publish("console", 1.6)
    rig.until(lambda: of(rig, "console").get("refused", 0) > 10, "the second is refused")
    first.end()
    rig.until(lambda: holds(rig, "console"), "the second holds the brake")
    assert of(rig, "patient")["state"] == "stale"


@pytest.mark.parametrize("sessions", [(1, 2), (None, None)], ids=["with session", "without"])
def test_a_restarted_publisher_is_followed_again(rig, publish, sessions):
    fields = [{} if session is None else {"session": session} for session in sessions]
    source = f"robot {sessions[0]}"
    first = publish(source, 1.0, **fields[0])
    first.seq = 10_000
    rig.until(lambda: holds(rig, source) and of(rig, source)["seq"] > 10_000, "the first run")
    first.end()
    publish(source, 1.2, **fields[1])
    rig.until(lambda: rig.status()["setpoint_cf"] == 1.2, "the second run")
    assert (of(rig, source)["restarts"], of(rig, source)["session"]) == (1, sessions[1])
    assert of(rig, source)["seq"] < 10_000


def test_a_wrong_number_locks_nobody_out(rig, publish):
    robot = publish("robot", 1.0)
    rig.until(lambda: holds(rig, "robot"), "heard")
    before = rig.status()["setpoints"]
    robot.say_once(2**63 - 1)
    # the next one is no number of a setpoint at all
    rig.publish(msgpack.packb({"v": VERSION, "source": "robot", "seq": 2**63, "stamp_ns": 1, "servo_cf": 2.0}))
    robot.force_N = 1.1
    rig.until(lambda: rig.status()["setpoint_cf"] == 1.1, "heard on")
    rig.until(lambda: rig.status()["setpoints"]["dropped"] == before["dropped"] + 1, "only the wrong one is dropped")
    rig.until(lambda: rig.status()["setpoints"]["refused"] == before["refused"] + 1, "and the impossible one refused")
    assert of(rig, "robot")["seq"] < 2**62
    assert of(rig, "robot")["restarts"] == 0


def test_a_clock_that_is_a_second_off_is_corrected_and_named(rig, publish):
    rig.arm()
    source = "clock"
    publish(source, 1.0, clock_s=1.0)
    rig.until(lambda: abs((rig.telemetry().measured_cf or 0.0) - 1.0) < 0.06, "1 N")
    rig.until(lambda: "1.000 s ahead of this machine's" in of(rig, source)["cause"], "it is named")
    assert "chrony" in of(rig, source)["remedy"]
    ages_ms = [rig.status()["setpoint_age_ms"] for _ in range(25)]
    assert min(ages_ms) >= 0.0
    assert sorted(ages_ms)[12] < VALID_MS
    assert of(rig, source)["clock_behind_ms"] == pytest.approx(-1e3, abs=20.0)


def test_a_clock_that_is_set_changes_nothing_and_is_named(rig, publish):
    source = "step"
    robot = publish(source, 1.0)
    rig.until(lambda: holds(rig, source) and of(rig, source)["accepted"] > 100, "heard")
    refused = of(rig, source)["refused"]
    robot.clock_s, robot.force_N = -1.0, 1.1
    rig.until(lambda: rig.status()["setpoint_cf"] == 1.1, "heard on")
    rig.until(lambda: of(rig, source)["clock_steps"] == 1, "the step is counted")
    rig.until(lambda: "this machine's" in of(rig, source)["cause"], "it is named")
    # not one was refused for it, none was too old
    assert of(rig, source)["refused"] == refused
    assert "STALE" not in rig.status()["limits"]


def test_the_whole_way_is_shown(rig, publish):
    rig.arm()
    robot = publish("robot", 1.0)

    def has_moved() -> bool:
        robot.force_N = 1.0 + 0.05 * (robot.sent // 50 % 8)
        way = rig.status()["way"]
        return way["total_ms"] is not None and way["to_duty_us"]["p50"] > 0.0

    rig.until(has_moved, "every part is known")
    way = rig.status()["way"]
    assert way["budget_ms"] == 400.0
    assert way["total_ms"] >= (way["to_duty_us"]["p99"] + way["device_us"]) * 1e-3 - 0.01
