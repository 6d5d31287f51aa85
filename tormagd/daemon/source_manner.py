"""How a publisher's setpoints come: too seldom, too late, unevenly, or with losses. Judged once a second at most.

No I/O and no clock: times are arguments.
"""

import math
from typing import NamedTuple

from msgspec import UNSET

from tormagd.config import MAX_PLAYOUT_MS
from tormagd.control.ask.governor import AHEAD_S
from tormagd.daemon.source_clock import MAX_LATE_S
from tormagd.safety.codes import Explanation, Limit
from tormagd.scenes.scene import Scene

WINDOW_S, MIN_MESSAGES = 1.0, 4
"Least time and least messages that are judged together."
MAX_LOST = 0.05
SPREAD_S = 0.02
"By more than this from message to message a delay shows in the force: what the slope carries over is 50 ms."
SLACK = 1.25
"A publisher's own timer may be so much slower than it is meant to be."
PLAYOUT_STEP_MS = 10
"A playout that is told as a remedy is rounded up to this."


class Needs(NamedTuple):
    """What the scene wants of a publisher: how many setpoints a second, and how old they may be when they come."""

    setpoint_hz: float = 1.0 / AHEAD_S
    delay_s: float = MAX_LATE_S


def needs_of(scene: Scene) -> Needs:
    """Return what a scene needs of its publisher: setpoints a second, and their greatest delay, s."""
    stated = UNSET if scene.signal is None else scene.signal.setpoint_hz
    delay_ms = scene.budget.delay_ms
    return Needs(
        Needs().setpoint_hz if stated is UNSET else stated,
        Needs().delay_s if delay_ms is UNSET else delay_ms * 1e-3,
    )


class Arrival(NamedTuple):
    """How one message came."""

    delay_s: float
    hidden_s: float
    playout_s: float
    lost: int
    preview_s: float


class SourceManner:
    """Judges how the setpoints of one publisher come, window by window. Give it each message."""

    def __init__(self) -> None:
        self.found: dict[Limit, Explanation] = {}
        "What was wrong in the newest full window."
        self._began_s: float | None = None
        self._lost = self._messages = 0
        self._least_s, self._most_s, self._sum_s = MAX_LATE_S, 0.0, 0.0

    def hear(self, now_s: float, arrival: Arrival, needs: Needs) -> None:
        """Take a message that came at `now_s`, and set `found` anew, by `needs`, when it fills the window."""
        if self._began_s is None:
            self._begin(now_s, arrival.lost)
            return
        late_s = max(arrival.delay_s, arrival.playout_s)
        self._messages += 1
        self._least_s, self._most_s = min(self._least_s, late_s), max(self._most_s, late_s)
        self._sum_s += late_s
        past_s = now_s - self._began_s
        if past_s >= WINDOW_S and self._messages >= MIN_MESSAGES:
            self.found = self._judged(past_s, arrival, needs)
            self._begin(now_s, arrival.lost)

    def _begin(self, now_s: float, lost: int) -> None:
        self._began_s, self._lost, self._messages = now_s, lost, 0
        self._least_s, self._most_s, self._sum_s = MAX_LATE_S, 0.0, 0.0

    def _judged(self, past_s: float, last: Arrival, needs: Needs) -> dict[Limit, Explanation]:
        """Return what is wrong in a window of `past_s`, s, that `last` has ended, with cause and remedy; empty where
        nothing is."""
        lost = last.lost - self._lost
        sent = self._messages + lost
        found = {}
        if lost > MAX_LOST * sent:
            found[Limit.SOURCE_LOSS] = Explanation(
                f"{lost / sent:.0%} of its setpoints are lost on the way", "look for the lossy part of the network"
            )
        spacing_s = past_s / sent
        if spacing_s > max(SLACK / needs.setpoint_hz, last.preview_s):
            found[Limit.SOURCE_SELDOM] = Explanation(
                f"it sends {1.0 / spacing_s:.1f} setpoints a second, and the scene needs {needs.setpoint_hz:g}",
                "send more often, or a preview_N that reaches to the next one",
            )
        mean_s = self._sum_s / self._messages + last.hidden_s
        if mean_s > needs.delay_s:
            is_held = last.playout_s > 0.0 and last.playout_s + last.hidden_s > needs.delay_s
            found[Limit.SOURCE_LATE] = Explanation(
                f"its setpoints are {mean_s * 1e3:.0f} ms late, and the scene allows {needs.delay_s * 1e3:.0f}",
                f"{'lower sources.playout_ms, ' if is_held else ''}take a shorter way, set the clocks by chrony, or "
                "send a preview_N of that length",
            )
        if self._most_s - self._least_s > SPREAD_S:
            from_ms, to_ms = ((each_s + last.hidden_s) * 1e3 for each_s in (self._least_s, self._most_s))
            found[Limit.SOURCE_JITTER] = Explanation(
                f"its setpoints are {from_ms:.0f} to {to_ms:.0f} ms late", _steadied(self._most_s * 1e3)
            )
        return found


def _steadied(most_ms: float) -> str:
    """Return the remedy for jitter of up to `most_ms` after the stamp, as a text for people."""
    playout_ms = math.ceil(most_ms / PLAYOUT_STEP_MS) * PLAYOUT_STEP_MS
    if playout_ms > MAX_PLAYOUT_MS:
        return "send a preview_N that is longer than that differs, or take a steadier way"
    return f"set sources.playout_ms = {playout_ms}, which delays every setpoint to that, or take a steadier way"
