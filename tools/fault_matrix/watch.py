"""What a fault brought about, tick by tick, and whether that is what had to come of it."""

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from fault_matrix.cases import FOLLOWED, HELD, HELD_OR_OPENS, LIMITED, OPENS, STAYS, Injection
from fault_matrix.rig import OTHER_N, Rig
from firmware_protocol.codec import DeviceMode
from tormagd.closed_loop import Sample
from tormagd.safety.codes import FAULTS, LIMITS, Fault, Limit
from tormagd.safety.operating_state import OperatingState, RefusedError

SAFE_N = 1.0
OPEN_MM = 94.0
LOSS_MS = 50
"A loss of force is what a hand feels of it: the greatest over so long."
MOST_OFF_N = 0.15
"A force that is held is off by no more, in the mean of the last second,"
MOST_OVER_N = 0.3
"and never too great by more."
MOST_CLOSED_MM = 3.0
"What is not driven, or homed, closes by no more than a few mm."
REFUSED_MS = 100.0
"A command is refused by then: at once."


class Cell(NamedTuple):
    """One row of the matrix. A time is null where it did not come to that within 6 s.

    `named`: one of the codes that it should have was told, and no other fault before. `safe`: it ended as stated, and
    `seconds` is when that began; for a force that is held, when it was named. `reacted_ms` is when the reaction was on
    its way: the device began to open or let go, the limit was told, or the command was refused. `in_time`: that was by
    `stated_ms`, which is null where nothing is to be told.

    The last four are of `fault_recovery`. `tried`: what the recovery came to before the cause had gone, empty where
    there was nothing to try. `recovery`: the commands that led back once it had, `back_s` how long they took, and
    `recovered`: they did, not before, and the force was followed again.
    """

    bus: str
    fault: str
    injected: str
    host_faults: tuple[str, ...]
    device_faults: tuple[str, ...]
    limits: tuple[str, ...]
    reaction: str
    noticed_ms: float | None
    below_1N_ms: float | None
    open_ms: float | None
    loss_N_s: float
    expected: str
    named: bool
    safe: bool
    seconds: float | None
    excitation: str
    must_be_named: tuple[str, ...]
    stated_ms: float | None
    reacted_ms: float | None
    in_time: bool
    tried: str = ""
    recovery: tuple[str, ...] = ()
    back_s: float | None = None
    recovered: bool = False


class Watch:
    """What the injection brought about, tick by tick."""

    def __init__(self, rig: Rig, usual: dict[str, None], *, is_driven: bool) -> None:
        """Watches `rig` from now on. `usual` are the limits that were held before, too: they notice nothing."""
        loop = rig.loop
        gap_mm = loop.simulated.truth.gap_mm
        self._rig, self._loop = rig, loop
        self._most_N = 0.0
        self._has_run = is_driven
        self._opening_s: float | None = None
        self._let_go_s: float | None = None
        self._usual, self._from_s, self._from_mm = usual, loop.now_s, gap_mm
        self._host: dict[str, None] = {}
        self._device: dict[str, None] = {}
        self._limits: dict[str, None] = {}
        self._refusal = ""
        self._forces_N: deque[float] = deque(maxlen=LOSS_MS + 1)
        self._loss_N_s = 0.0
        self._noticed_s: float | None = None
        self._below_s: float | None = None
        self._open_s: float | None = None
        self._resting_s: float | None = None
        self._least_mm = gap_mm
        self._over_N = 0.0
        self._off_N: list[float] = []

    def see(self, sample: Sample | None) -> None:
        """Takes one tick; `sample` is None while the daemon is dead."""
        loop = self._loop
        truth, firmware = loop.simulated.truth, loop.simulated.firmware
        if sample is not None:
            self._host |= dict.fromkeys(map(str, sample.state.safety.faults))
            if sample.state.safety.operating_state in (OperatingState.ENABLED, OperatingState.PAUSED):
                held = map(str, (*sample.plan.limits, *sample.output.limits))
                self._limits |= dict.fromkeys(limit for limit in held if limit not in self._usual)
        self._device |= dict.fromkeys(fault.name or "" for fault in firmware.faults)
        self._forces_N.append(truth.force_N)
        if len(self._forces_N) > LOSS_MS:
            self._loss_N_s = max(self._loss_N_s, (self._forces_N[0] - truth.force_N) / (LOSS_MS * 1e-3))
        first = _first(loop.now_s)
        if self._host or self._device or self._limits:
            self._noticed_s = first(self._noticed_s)
        # a force that is let go and comes back was not safe
        self._below_s = first(self._below_s) if truth.force_N < SAFE_N else None
        self._open_s = first(self._open_s) if truth.gap_mm > OPEN_MM else None
        self._resting_s = None if firmware.output.enabled else first(self._resting_s)
        if firmware.mode is DeviceMode.RUN:
            self._has_run = True
        elif self._has_run:
            self._let_go_s = first(self._let_go_s)
            if firmware.mode is DeviceMode.RETRACTING:
                self._opening_s = first(self._opening_s)
        self._most_N = max(self._most_N, truth.force_N)
        self._least_mm = min(self._least_mm, truth.gap_mm)
        off_N = self._rig.off_N
        self._over_N = max(self._over_N, off_N)
        self._off_N.append(off_N)

    @property
    def is_open(self) -> bool:
        """Whether the gap is open, and no force left that could be lost."""
        return self._open_s is not None

    def refuse(self, error: RefusedError) -> None:
        """A command was refused."""
        self._refusal = f"{error.code}: {error.message.partition(': ')[2]}"
        self._noticed_s = _first(self._loop.now_s)(self._noticed_s)

    def cell(self, injection: Injection, bus: str) -> Cell:
        """The row."""
        loop = self._loop
        state = loop.step_state.safety.operating_state
        mode = loop.simulated.firmware.mode.name
        noticed_ms = self._since(self._noticed_s)
        is_safe, safe_ms = self._ended(injection.safe, noticed_ms)
        stated_ms, reacted_ms = self._stated_ms(injection), self._reacted_ms(injection)
        return Cell(
            bus,
            injection.name,
            injection.name,
            tuple(self._host),
            tuple(self._device),
            (*self._limits, *([self._refusal] if self._refusal else [])),
            f"daemon {state}, device {mode}",
            noticed_ms,
            self._since(self._below_s),
            self._since(self._open_s),
            round(self._loss_N_s, 2),
            injection.safe,
            self._is_named(injection.names),
            is_safe,
            None if safe_ms is None else round(safe_ms * 1e-3, 4),
            injection.excitation,
            injection.names,
            stated_ms,
            reacted_ms,
            stated_ms is None or (reacted_ms is not None and reacted_ms <= stated_ms),
        )

    def _stated_ms(self, injection: Injection) -> float | None:
        """By when the reaction has to be on its way, by the table of the code that was told."""
        if injection.within_ms is not None:
            return injection.within_ms
        for name in injection.names:
            if name in self._host:
                return FAULTS[Fault(name)].safe_ms
            if name in self._limits:
                return LIMITS[Limit(name)].safe_ms
            if name.startswith("device:"):
                return FAULTS[Fault(name.replace("device:", "DEVICE_"))].safe_ms
            if self._refusal.startswith(name):
                return REFUSED_MS
        return None

    def _reacted_ms(self, injection: Injection) -> float | None:
        """When the device began to open, where it does, or let go; when it was told otherwise."""
        if self._refusal:
            return self._since(self._noticed_s)
        if not self._has_run:
            return self._since(self._resting_s)
        began_s = self._let_go_s if injection.safe == STAYS else self._opening_s
        return self._since(self._noticed_s if began_s is None else began_s)

    def _is_named(self, names: tuple[str, ...]) -> bool:
        if not names:
            return not self._host
        told = [*self._host, *self._limits, *(f"device:{fault}" for fault in self._device)]
        is_told = any(name in told or (self._refusal and self._refusal.startswith(name)) for name in names)
        first = next(iter(self._host), None)
        # what is latched first is what a person reads first
        return is_told and (first is None or first in names or names[0].startswith("device:"))

    def _ended(self, safe: str, noticed_ms: float | None) -> tuple[bool, float | None]:
        """Whether it ended as stated, and since when."""
        has_opened = self._open_s is not None and self._below_s is not None
        last_second = self._off_N[-1000:]
        is_held = abs(sum(last_second) / len(last_second)) < MOST_OFF_N and self._over_N < MOST_OVER_N
        if safe == STAYS:
            is_still = self._resting_s is not None and self._least_mm > self._from_mm - MOST_CLOSED_MM
            return is_still, self._since(self._resting_s)
        if safe == LIMITED:
            return not self._host and self._most_N < self._rig.most_N + MOST_OVER_N, noticed_ms
        if safe == FOLLOWED:
            is_there = abs(self._forces_N[-1] - OTHER_N) < MOST_OFF_N and self._over_N < MOST_OVER_N
            return is_there and not self._host, self._since(self._below_s)
        if has_opened and safe in (OPENS, HELD_OR_OPENS):
            return True, self._since(self._open_s)
        return safe in (HELD, HELD_OR_OPENS) and is_held and not self._host, noticed_ms

    def _since(self, time_s: float | None) -> float | None:
        return None if time_s is None else round((time_s - self._from_s) * 1e3, 1)


def _first(now_s: float) -> Callable[[float | None], float]:
    return lambda known: now_s if known is None else known
