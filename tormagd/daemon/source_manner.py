"""How a publisher's setpoints come: too seldom, too late, unevenly, or with losses. Judged once a second.

No I/O and no clock: times are arguments.
"""

from typing import NamedTuple

from msgspec import UNSET

from tormagd.control.ask.governor import AHEAD_S
from tormagd.safety.codes import Explanation, Limit
from tormagd.scenes.scene import Scene

WINDOW_S, LEAST_MESSAGES = 1.0, 4
"Least time and least messages that are judged together."
MOST_LOST = 0.05
SPREAD_S = 0.02
"By more than this from message to message a delay shows in the force: what the slope carries over is 50 ms."
SLACK = 1.25
"A publisher's own timer may be so much slower than it is meant to be."
MOST_LATE_S = 1.0
"A stamp that is older is of a wrong clock."


class Needs(NamedTuple):
    """What the scene wants of a publisher: how many setpoints a second, and how old they may be when they come."""

    setpoint_hz: float = 1.0 / AHEAD_S
    delay_s: float = MOST_LATE_S


def needs_of(scene: Scene) -> Needs:
    """Return what a scene needs of its publisher: setpoints a second, and their greatest delay, s.

    Where the scene states none, setpoints may be as far apart as the slope carries over, and late by MOST_LATE_S.
    """
    stated = UNSET if scene.signal is None else scene.signal.setpoint_hz
    delay_ms = scene.budget.delay_ms
    return Needs(
        Needs().setpoint_hz if stated is UNSET else stated,
        Needs().delay_s if delay_ms is UNSET else delay_ms * 1e-3,
    )


class SourceManner:
    """Judges once a second how the setpoints of one publisher come. Give it each message.

    `found` has what was wrong in the newest full window, by limit.
    """

    def __init__(self) -> None:
        self.found: dict[Limit, Explanation] = {}
        "What was wrong in the newest full window."
        self._began_s: float | None = None
        self._lost = self._messages = 0
        self._least_s, self._most_s, self._sum_s = MOST_LATE_S, 0.0, 0.0

    def hear(self, now_s: float, late_s: float, lost: int, preview_s: float, needs: Needs) -> None:
        """Take a message, `late_s` after its stamp by the corrected clock; set `found` anew when a window is full.

        `lost` counts all messages missing so far. `preview_s` is the length of its preview, 0 without one. The first
        message only begins the window.
        """
        if self._began_s is None:
            self._begin(now_s, lost)
            return
        self._messages += 1
        self._least_s, self._most_s = min(self._least_s, late_s), max(self._most_s, late_s)
        self._sum_s += late_s
        past_s = now_s - self._began_s
        if past_s >= WINDOW_S and self._messages >= LEAST_MESSAGES:
            self.found = self._judged(past_s, lost - self._lost, preview_s, needs)
            self._begin(now_s, lost)

    def _begin(self, now_s: float, lost: int) -> None:
        self._began_s, self._lost, self._messages = now_s, lost, 0
        self._least_s, self._most_s, self._sum_s = MOST_LATE_S, 0.0, 0.0

    def _judged(self, past_s: float, lost: int, preview_s: float, needs: Needs) -> dict[Limit, Explanation]:
        """Return what is wrong in a window of `past_s` in which `lost` messages were missing; empty where nothing is.

        SOURCE_LOSS, SOURCE_SELDOM (not within `preview_s`), SOURCE_LATE and SOURCE_JITTER may be found.
        """
        sent = self._messages + lost
        found = {}
        if lost > MOST_LOST * sent:
            found[Limit.SOURCE_LOSS] = Explanation(
                f"{lost / sent:.0%} of its setpoints are lost on the way", "look for the lossy part of the network"
            )
        spacing_s = past_s / sent
        if spacing_s > max(SLACK / needs.setpoint_hz, preview_s):
            found[Limit.SOURCE_SELDOM] = Explanation(
                f"it sends {1.0 / spacing_s:.1f} setpoints a second, and the scene needs {needs.setpoint_hz:g}",
                "send more often, or a preview_N that reaches to the next one",
            )
        mean_s = self._sum_s / self._messages
        if mean_s > needs.delay_s:
            found[Limit.SOURCE_LATE] = Explanation(
                f"its setpoints come {mean_s * 1e3:.0f} ms late, and the scene allows {needs.delay_s * 1e3:.0f}",
                "take a shorter way, set the clocks by chrony, or send a preview_N of that length",
            )
        if self._most_s - self._least_s > SPREAD_S:
            found[Limit.SOURCE_JITTER] = Explanation(
                f"its setpoints come {self._least_s * 1e3:.0f} to {self._most_s * 1e3:.0f} ms late",
                "send a preview_N that is longer than that differs, or take a steadier way",
            )
        return found
