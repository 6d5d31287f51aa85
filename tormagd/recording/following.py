"""How well the measured force followed the asked one: RMS as recorded, and with the delay taken out.

Following begins with an ENABLED device and a fresh setpoint, once the measured force is within NEAR_N of the asked one
or APPROACH_NS have passed. It ends with the state or the setpoint. So neither approach nor decay is counted.
"""

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import msgspec

AWAY = frozenset({"NO_SETPOINT", "STALE", "TAKEOVER"})
"Limits under which the setpoint does not rule the force."
NEAR_N = 0.15
APPROACH_NS = 1_000_000_000
STEP_NS = 10_000_000
"Step between the delays tried, and between the times at which they are."
DELAYS = 31


class Followed(msgspec.Struct, frozen=True):
    """How a force was followed: RMS of measured minus asked, for how long, and the RMS at the delay where it is least.

    `aligned_rms_N` compares the force with what was asked `delay_ms` earlier. None where nothing was followed, or too
    little to tell a delay. Both RMS values include the sensor's noise.
    """

    rms_N: float | None = None
    seconds: float = 0.0
    aligned_rms_N: float | None = None
    delay_ms: float | None = None


class Following:
    """Sums up the error between measured and asked force, message by message, in bounded memory.

    Holds sums of squares, as recorded and for each of DELAYS delays, and the asked forces of the last delays. It also
    knows whether the force is followed now.
    """

    def __init__(self) -> None:
        self._count, self._sum, self._lasted_ns = 0, 0.0, 0
        self._last_ns = self._looked_ns = self._began_ns = 0
        self._is_due = self._is_following = False
        self._asked: deque[float] = deque(maxlen=DELAYS)
        self._sums, self._counts = [0.0] * DELAYS, [0] * DELAYS

    def add(self, t_ns: int, asked_N: float | None, measured_N: float | None, message: Mapping[str, Any]) -> None:
        """Add the next message with its forces; following ends where either is None, or the setpoint does not rule.

        It begins at an error within NEAR_N, or APPROACH_NS after the setpoint began to rule. Tries each of DELAYS
        delays once every STEP_NS. `message` gives `operating_state` and `limits`.
        """
        if asked_N is None or measured_N is None or not is_asked(message):
            self._is_due = self._is_following = False
            self._asked.clear()
            self._last_ns = t_ns
            return
        if not self._is_due:
            self._is_due, self._began_ns, self._looked_ns = True, t_ns, t_ns - STEP_NS
        error_N = measured_N - asked_N
        if not self._is_following:
            self._is_following = abs(error_N) <= NEAR_N or t_ns - self._began_ns >= APPROACH_NS
        if self._is_following:
            self._count += 1
            self._sum += error_N * error_N
            self._lasted_ns += min(max(t_ns - self._last_ns, 0), STEP_NS * 10)
        self._last_ns = t_ns
        if (passed_ns := t_ns - self._looked_ns) >= STEP_NS:
            if passed_ns >= 2 * STEP_NS:
                self._asked.clear()  # too coarse to tell a delay by
            self._looked_ns = t_ns
            self._asked.appendleft(asked_N)
            if self._is_following:
                for i, earlier_N in enumerate(self._asked):
                    self._sums[i] += (measured_N - earlier_N) ** 2
                    self._counts[i] += 1

    def made(self) -> Followed | None:
        """Report the error so far; None where nothing was followed.

        `aligned_rms_N` and `delay_ms` are None where messages came too far apart to tell a delay.
        """
        if not self._count:
            return None
        rms_N = math.sqrt(self._sum / self._count)
        means = [total / count for total, count in zip(self._sums, self._counts, strict=True) if count]
        if not means:
            return Followed(rms_N, self._lasted_ns * 1e-9)
        best = min(range(len(means)), key=means.__getitem__)
        return Followed(rms_N, self._lasted_ns * 1e-9, math.sqrt(means[best]), best * STEP_NS * 1e-6)


def is_asked(message: Mapping[str, Any]) -> bool:
    """Return whether the setpoint rules the force: ENABLED, or no state recorded, and no limit of AWAY."""
    state = message.get("operating_state")
    return state in (None, "ENABLED") and AWAY.isdisjoint(message.get("limits") or ())
