"""The patient, simulated: what a robot's tip meets, and the network between.

A robot's tip follows the handle late, rubs in a vessel, and meets a wall. `python -m tormagd.simulation.patient` sends
what it feels to the daemon, as any patient's unit. `Patient` and `NetworkDelay` live in the time that they are given,
which never falls.
"""

import argparse
import heapq
import math
import random
import signal
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, Final, Generic, NamedTuple, TypeVar

from tormagd.element.physics.friction import Friction
from tormagd.ground.command_line import add, option
from tormagd.ground.terminal import interrupted_by
from tormagd_client import Client, ClientError
from tormagd_client.contact import ContactEstimator

T = TypeVar("T")
PERIOD_S: Final = 2e-3
VALID_MS: Final = 100.0
FORCE, WAY, LAW, FOUND = MODES = ("force", "way", "law", "found")
"The tip's force, the force of each way, the wall once it is met, or once a touch has shown it to the estimator."
VESSEL: Final = Friction(presliding_stiffness_N_mm=2.0, viscous_N_s_mm=0.0, static_ratio=1.2, stribeck_speed_mm_s=2.0)
"An assumption: the tip sticks, and slips at less force."


class Felt(NamedTuple):
    """Forces at the tip, which has gone on by `way_mm`. `force_N` resists the way in, `friction_N` is the vessel's
    while the tip slides.
    """

    tip_mm: float
    way_mm: float
    force_N: float
    wall_N: float
    friction_N: float
    stiffness_N_mm: float
    contact_mm: float | None


class Patient:
    """A robot's tip that follows the handle late, in a vessel with an elastic wall, which may beat."""

    def __init__(
        self,
        *,
        lag_s: float = 0.02,
        friction_N: float = 0.1,
        wall_mm: float = math.inf,
        stiffness_N_mm: float = 0.5,
        buckling_N: float = math.inf,
        beat_mm: float = 0.0,
        beat_hz: float = 1.2,
    ) -> None:
        is_wall = not math.isnan(wall_mm) and 0.0 < stiffness_N_mm < math.inf
        if not (lag_s > 0.0 and is_wall and 0.0 <= friction_N < buckling_N):
            raise ValueError(
                f"lag_s = {lag_s}, wall_mm = {wall_mm}, stiffness_N_mm = {stiffness_N_mm}, friction_N = {friction_N}, "
                f"buckling_N = {buckling_N}: allowed are a lag and a stiffness above 0, and a friction from 0 to under "
                "buckling_N"
            )
        self._lag_s, self._friction_N, self._stiffness_N_mm = lag_s, friction_N, stiffness_N_mm
        self._wall_mm, self._beat_mm, self._beat_hz = wall_mm, beat_mm, beat_hz
        self._buckling_N = buckling_N
        self._time_s = math.nan
        self._start_mm = self._robot_mm = self._tip_mm = 0.0
        self._rubbing_N = self._deflection_mm = 0.0
        self._contact_mm: float | None = None

    def update(self, time_s: float, handle_mm: float) -> Felt:
        """Advance to `time_s`, and return what the tip feels."""
        if math.isnan(self._time_s):
            self._time_s, self._start_mm, self._robot_mm, self._tip_mm = time_s, handle_mm, handle_mm, handle_mm
        dt_s, self._time_s = time_s - self._time_s, time_s
        self._robot_mm -= (handle_mm - self._robot_mm) * math.expm1(-dt_s / self._lag_s)
        wall_mm = self._start_mm + self._wall_mm + self._beat_mm * math.sin(math.tau * self._beat_hz * time_s)
        before_mm, furthest_mm = self._tip_mm, wall_mm + (self._buckling_N - self._friction_N) / self._stiffness_N_mm
        self._tip_mm = tip_mm = min(self._robot_mm, furthest_mm)
        if dt_s > 0.0:
            self._rubbing_N, self._deflection_mm = VESSEL.advance(
                self._deflection_mm, (tip_mm - before_mm) / dt_s, self._friction_N, dt_s
            )
        wall_N = self._stiffness_N_mm * max(tip_mm - wall_mm, 0.0)
        if wall_N > 0.0:
            self._contact_mm = wall_mm
        force_N = min(wall_N + self._rubbing_N, self._buckling_N)
        return Felt(
            tip_mm, tip_mm - before_mm, force_N, wall_N, self._friction_N, self._stiffness_N_mm, self._contact_mm
        )


def setpoint_of(felt: Felt, mode: str) -> dict[str, Any]:
    """Return the fields of a setpoint that says what the tip feels."""
    if mode in (FORCE, FOUND):
        return {"servo_cf": abs(felt.force_N)}
    fields: dict[str, Any] = {"servo_cf": felt.wall_N + felt.friction_N}
    if mode == WAY:
        fields["withdraw_cf"] = felt.friction_N
    elif felt.contact_mm is not None:
        fields["contact"] = {
            "handle_mm": felt.contact_mm,
            "stiffness_N_mm": felt.stiffness_N_mm,
            "friction_N": felt.friction_N,
        }
    return fields


class NetworkDelay(Generic[T]):
    """One direction of a network: a delay, jitter on top, losses in bursts, and one outage."""

    def __init__(
        self,
        delay_s: float = 0.0,
        jitter_s: float = 0.0,
        loss: float = 0.0,
        burst: float = 1.0,
        outage_s: tuple[float, float] = (math.inf, math.inf),
        seed: int = 0,
    ) -> None:
        if not (delay_s >= 0.0 and jitter_s >= 0.0 and burst >= 1.0 and 0.0 <= loss <= 0.5):
            raise ValueError(
                f"delay_s = {delay_s}, jitter_s = {jitter_s}, loss = {loss}, burst = {burst}: allowed are times "
                "from 0, a loss of 0 to 0.5 and bursts from 1"
            )
        self._delay_s, self._jitter_s, self._outage_s = delay_s, jitter_s, outage_s
        self._begins, self._goes_on = loss / (burst * (1.0 - loss)), 1.0 - 1.0 / burst
        self._draw = random.Random(f"delay {seed}")
        self._is_losing = False
        self._sent = 0
        self._under_way: list[tuple[float, int, float, T]] = []

    def send(self, time_s: float, value: T) -> None:
        chance, arrives_s = self._draw.random(), time_s + self._delay_s + self._jitter_s * self._draw.random()
        self._is_losing = chance < (self._goes_on if self._is_losing else self._begins)
        self._sent += 1
        if not self._is_losing and not self._outage_s[0] <= time_s < self._outage_s[1]:
            heapq.heappush(self._under_way, (arrives_s, self._sent, time_s, value))

    def arrived(self, time_s: float) -> list[tuple[float, T]]:
        """Return the time of sending and the value of all that has arrived since the last call."""
        found = []
        while self._under_way and self._under_way[0][0] <= time_s:
            found.append(heapq.heappop(self._under_way)[2:])
        return found


class Unit:
    """The patient's unit at the far end of a network."""

    def __init__(self, patient: Patient, mode: str, network: tuple[float, float, float, float]) -> None:
        self._patient, self._mode = patient, mode
        self._there: NetworkDelay[float] = NetworkDelay(*network, seed=1)
        self._back: NetworkDelay[dict[str, Any]] = NetworkDelay(*network, seed=2)
        self._estimator = ContactEstimator()
        self._handle, self._sent_s = (-math.inf, 0.0), -math.inf

    def update(self, now_s: float, handle_mm: Sequence[float]) -> list[tuple[float, dict[str, Any]]]:
        """Send the handle's places there and a setpoint back; return what has come, with the time of sending."""
        for place_mm in handle_mm:
            self._there.send(now_s, place_mm)
        self._handle = max([self._handle, *self._there.arrived(now_s)])
        if self._handle[0] > -math.inf:
            self._back.send(now_s, self._setpoint(self._patient.update(now_s, self._handle[1])))
        arrived = []
        for sent_s, fields in self._back.arrived(now_s):
            if sent_s > self._sent_s:  # what was overtaken is of no use
                arrived.append((sent_s, fields))
                self._sent_s = sent_s
        return arrived

    def _setpoint(self, felt: Felt) -> dict[str, Any]:
        fields = setpoint_of(felt, self._mode)
        if self._mode == FOUND:
            self._estimator.update(felt.tip_mm, felt.force_N, felt.way_mm)
            if (wall := self._estimator.contact) is not None:
                fields["contact"] = wall
        return fields


def run(
    client: Any,
    unit: Unit,
    is_over: Callable[[float], bool],
    clock_s: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> int:
    """Run the unit every PERIOD_S until `is_over`; return how many setpoints it has published."""
    began_ns, due_s, published = time.time_ns() - round(1e9 * clock_s()), clock_s(), 0
    while not is_over(now_s := clock_s()):
        for sent_s, fields in unit.update(now_s, [motion.handle_mm for motion in client.motions()]):
            client.publish(fields.pop("servo_cf"), VALID_MS, began_ns + round(1e9 * sent_s), **fields)
            published += 1
        due_s = max(due_s + PERIOD_S, now_s)
        wait(max(due_s - clock_s(), 0.0))
    return published


OPTIONS = (
    option("folder", help="where the daemon's sockets are"),
    option("--mode", choices=MODES, default=FORCE, help="what a setpoint says"),
    option("--delay-ms", type=float, default=0.0, metavar="MS", help="each way"),
    option("--jitter-ms", type=float, default=0.0, metavar="MS", help="each way, on top of the delay"),
    option("--loss", type=float, default=0.0, metavar="SHARE", help="each way, in bursts of 3"),
    option("--wall-mm", type=float, default=10.0, metavar="MM", help="from where the handle is first seen"),
    option("--stiffness-N-mm", type=float, default=0.5, metavar="N/MM", help="of the wall"),
    option("--friction-N", type=float, default=0.1, metavar="N", help="of the vessel"),
    option("--seconds", type=float, default=math.inf, metavar="S", help="default until it is interrupted"),
)


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="python -m tormagd.simulation.patient", description="A simulated patient, the source of setpoints."
    )
    add(made, OPTIONS)
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    command = parser()
    options = command.parse_args(arguments)
    try:
        patient = Patient(friction_N=options.friction_N, wall_mm=options.wall_mm, stiffness_N_mm=options.stiffness_N_mm)
        unit = Unit(patient, options.mode, (1e-3 * options.delay_ms, 1e-3 * options.jitter_ms, options.loss, 3.0))
    except ValueError as error:
        command.error(str(error))
    ends_s = time.monotonic() + options.seconds
    with interrupted_by(signal.SIGTERM, signal.SIGINT) as is_stopped:
        try:
            with Client.local(options.folder, 5.0, "patient") as client:
                ends = lambda now_s: is_stopped() or now_s >= ends_s  # noqa: E731 it is asked in every period
                published = run(client, unit, ends)
        except (ClientError, ValueError) as error:
            print(f"{command.prog}: {error}", file=sys.stderr)
            return 1
    if not published:
        print(
            f"{command.prog}: the daemon told no motion of a handle in time: nothing was published",
            file=sys.stderr,
        )
    return 0 if published else 1


if __name__ == "__main__":
    sys.exit(main())
