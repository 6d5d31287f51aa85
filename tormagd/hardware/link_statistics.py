"""How well the wire carries messages, how long it takes, and how the device's clock runs against the host's.

The conversation feeds all three with every Drive and State, and each keeps a bounded number of figures. What costs more
than a comparison is computed when it is asked for. Every measurement carries the `LinkQuality` of the last second, a
warning before a slow loop swings: so a step decides on its inputs alone, and a replay decides the same.
"""

import math
from collections import deque
from collections.abc import Sequence
from itertools import compress
from typing import ClassVar, Final, TypeAlias, final

from firmware_protocol.value import Value
from tormagd_client.messages import ClockReport, RoundTripReport

LOOKED_S: Final = 0.1
LOOKS: Final = 10
SETTLING_LOOKS: Final = 3
"The first looks of a conversation do not count: the answers to the last Drives are still on their way."
LOSES: Final = 0.02
"A wire that loses or damages a greater share is lossy: a sound serial cable or CAN bus loses none."


@final
class LinkQuality(Value):
    def __init__(
        self,
        unanswered: float = 0.0,
        damaged: float = 0.0,
        unsent: float = 0.0,
        round_trip_s: float = 0.0,
        clock_drift: float = 0.0,
    ) -> None:
        self.unanswered: Final = unanswered
        self.damaged: Final = damaged
        self.unsent: Final = unsent
        self.round_trip_s: Final = round_trip_s
        self.clock_drift: Final = clock_drift

    @property
    def lost(self) -> float:
        return max(self.unanswered, self.unsent)

    @property
    def is_lossy(self) -> bool:
        return self.lost > LOSES or self.damaged > LOSES

    def __str__(self) -> str:
        return (
            f"{self.unanswered:.1%} of the Drives were not answered, {self.damaged:.1%} of the frames came damaged, "
            f"{self.unsent:.1%} were not taken by the wire, the round trip is {self.round_trip_s * 1e3:.1f} ms"
        )


UNKNOWN_QUALITY: Final = LinkQuality()


Counts: TypeAlias = tuple[int, int, int, int, int]
"Drives, States, frames and damaged frames, and messages that the wire did not take, since the conversation began."


@final
class LinkWatch:
    __match_args__: ClassVar = ("_counts", "_due_s", "_round_trip_s")

    def __init__(self, now_s: float) -> None:
        self._due_s = now_s + SETTLING_LOOKS * LOOKED_S
        self._counts: deque[Counts] = deque(maxlen=LOOKS + 1)
        self._round_trip_s = 0.0

    def is_due(self, now_s: float) -> bool:
        return now_s >= self._due_s

    def look(self, now_s: float, counts: Counts, round_trip_s: float, clock_drift: float) -> LinkQuality:
        """Return the quality over the last LOOKS looks, and set when the next is due."""
        self._due_s = now_s + LOOKED_S
        self._counts.append(counts)
        drives, states, frames, damaged, unsent = [new - old for new, old in zip(counts, self._counts[0], strict=True)]
        # at 4 kHz one pause fills the window of the usual round trip; by the next look it has left
        least_s, self._round_trip_s = min(self._round_trip_s, round_trip_s), round_trip_s
        return LinkQuality(
            1.0 - _share(states, drives, of_none=1.0),
            _share(damaged, frames + damaged),
            _share(unsent, drives),
            least_s,
            clock_drift,
        )


def _share(part: int, whole: int, of_none: float = 0.0) -> float:
    return min(part / whole, 1.0) if whole > 0 else of_none


ROUND_TRIPS = 256
"Percentiles are taken from these: a quarter of a second of control."
USUAL_OF: Final = 101
"The median is taken from these: over twice the 50 late ones after a device stood still, at 1 kHz."
WINDOW_S = 0.5
"The least delayed State of a window stands for all of it: queues on the way only ever add."
WINDOWS = 60
MIN_WINDOWS = 6
OUTLIER = 4.0
"A window further off than so many standard deviations (by the median absolute deviation) does not count."
MAX_RESIDUAL_US = 2_000.0
NEWEST_WINDOWS = 3
"When this many newest windows all lie off the line, the clock has left it."
DRIFT_WINDOWS: Final = 8
"The drift is taken from these: a clock that runs wrong is known after four seconds."
STANDING: Final = 20
"After more States in a row with one time the clock stands."
CLOCK_STEP_S = 1e-5
"Resolution of State.device_time_s; a window one step off the line is no outlier."


Windows: TypeAlias = Sequence[tuple[float, float]]
"For each window, the host's time less the device's, and the host's time, s."


@final
class RoundTrip:
    """Times from handing a Drive to the wire until its State has been read, s."""

    __match_args__: ClassVar = (
        "_before_hello", "_lead", "_newest", "_newest_s", "_recent", "_sent_s", "_state", "_unsure",
    )  # fmt: skip

    def __init__(self) -> None:
        self._sent_s = [math.inf] * 256
        self._newest = 0
        self._before_hello: int | None = None
        self._state: int | None = None
        self._lead: int | None = None
        self._newest_s = 0.0
        self._unsure: deque[float] = deque(maxlen=ROUND_TRIPS)
        self._recent: deque[float] = deque(maxlen=ROUND_TRIPS)

    def drive(self, counter: int, now_s: float) -> None:
        self._newest = counter
        self._sent_s[counter] = now_s

    def since_next_s(self, counter: int, now_s: float) -> float:
        """Return the time since the Drive after the one with this counter went out."""
        return 0.0 if counter == self._newest else max(0.0, now_s - self._sent_s[(counter + 1) % 256])

    def hello(self) -> None:
        self._before_hello = self._newest

    def identity(self) -> None:
        """Note the Identity for the newest Hello: it fixes the offset between Drive and State counters."""
        if self._before_hello is not None and self._state is not None:
            self._lead = self._before_hello - self._state
        self._before_hello = None

    def state(self, counter: int, now_s: float) -> None:
        """Note a State; its round trip counts once a Status confirms it."""
        self._state, self._newest_s = counter, now_s
        lead = self._lead
        if lead is None:
            return
        answered = (counter + lead) % 256
        if (self._newest - answered) % 256 < 128:
            self._unsure.append(now_s - self._sent_s[answered])
        else:  # it would answer a Drive that has not been sent
            self._lead = None

    def status(self, drive_counter: int) -> None:
        """Count the round trips since the last Status if the last accepted Drive fits them; otherwise begin anew."""
        state, lead = self._state, self._lead
        if state is None:
            return
        if lead is not None and (drive_counter - state - lead + 1) % 256 <= 2:
            # the answer to that Drive is the newest State, or on its way, or the next has overtaken the Status
            for round_trip_s in self._unsure:
                self._take(round_trip_s)
        else:
            self._lead = drive_counter - state
            self._recent.clear()
            if (self._newest - drive_counter) % 256 < 128:
                self._take(self._newest_s - self._sent_s[drive_counter])
        self._unsure.clear()

    def _take(self, round_trip_s: float) -> None:
        if round_trip_s >= 0.0:
            self._recent.append(round_trip_s)

    @property
    def usual_s(self) -> float:
        ordered_s = sorted(list(self._recent)[-USUAL_OF:])
        return ordered_s[len(ordered_s) // 2] if ordered_s else 0.0

    @property
    def least_s(self) -> float:
        return min(self._recent, default=0.0)

    def report(self) -> RoundTripReport | None:
        ordered_s = sorted(self._recent)
        if not ordered_s:
            return None
        return RoundTripReport(*[round(ordered_s[int(share * len(ordered_s))] * 1e6, 1) for share in (0.0, 0.5, 0.99)])


@final
class DeviceClock:
    """The device's clock against the host's, by regression over the least delayed State of each window."""

    __match_args__: ClassVar = ("_ends_s", "_least", "_newest_s", "_standing", "_windows", "drift")

    def __init__(self) -> None:
        self._windows: deque[tuple[float, float]] = deque(maxlen=WINDOWS)
        self._least: tuple[float, float] = (math.inf, 0.0)
        self._ends_s = -math.inf
        self._newest_s = -math.inf
        self._standing, self.drift = 0, 0.0
        "The share by which the clock runs fast; 0 while unknown, -1 for a clock that stands."

    def add(self, host_s: float, device_s: float) -> None:
        """Take a State latched at `device_s` on the device's clock and read at `host_s`."""
        if device_s != self._newest_s:
            self._newest_s, self._standing = device_s, 0
        else:
            self._standing += 1
            if self._standing > STANDING:
                self.drift = -1.0
        offset_s = host_s - device_s
        if host_s >= self._ends_s:
            self._turn(host_s)
        if offset_s < self._least[0]:
            self._least = (offset_s, host_s)

    def fit(self) -> ClockReport | None:
        """Return the line of the host's time less the device's."""
        return _newest_line(list(self._windows))

    def _turn(self, host_s: float) -> None:
        """Begin the next window, and renew `drift`."""
        if self._least[0] < math.inf:
            self._windows.append(self._least)
            newest = _newest_line(list(self._windows)[-DRIFT_WINDOWS:])
            if self._standing <= STANDING:
                self.drift = 0.0 if newest is None else newest.drift_ppm * 1e-6
        self._least = (math.inf, 0.0)
        self._ends_s = host_s + WINDOW_S


def _newest_line(windows: Windows) -> ClockReport | None:
    """Return the line through the newest of `windows`, which are in order of time."""
    # no line fits across a clock that was set or stood still, so the older half goes until one does
    while len(windows) >= MIN_WINDOWS:
        fit, is_left = _robust_line(windows)
        if fit.residual_us < MAX_RESIDUAL_US and not is_left:
            return fit
        windows = windows[len(windows) // 2 :]
    return None


def _robust_line(windows: Windows) -> tuple[ClockReport, bool]:
    """Return the line through the windows, and whether all of the NEWEST_WINDOWS lie off it."""
    newest_s = windows[-1][1]
    half = len(windows) // 2
    slope = _median([(b[0] - a[0]) / (b[1] - a[1]) for a, b in zip(windows, windows[-half:], strict=False)])
    levels_s = [offset_s - slope * (time_s - newest_s) for offset_s, time_s in windows]
    level_s = _median(levels_s)
    most_s = max(OUTLIER * 1.4826 * _median([abs(each_s - level_s) for each_s in levels_s]), 1.5 * CLOCK_STEP_S)
    on_line = [abs(each_s - level_s) <= most_s for each_s in levels_s]
    kept = list(compress(windows, on_line))
    centre_s = sum([time_s for _, time_s in kept], 0.0) / len(kept)
    level_s = sum([offset_s for offset_s, _ in kept], 0.0) / len(kept)
    slope = sum([(offset_s - level_s) * (time_s - centre_s) for offset_s, time_s in kept], 0.0) / sum(
        [(time_s - centre_s) ** 2 for _, time_s in kept], 0.0
    )
    squares = [(offset_s - level_s - slope * (time_s - centre_s)) ** 2 for offset_s, time_s in kept]
    fit = ClockReport(
        offset_s=level_s + slope * (newest_s - centre_s),
        # host - device falls by the drift with every second of the host
        drift_ppm=-slope * 1e6,
        residual_us=math.sqrt(sum(squares, 0.0) / len(kept)) * 1e6,
        windows=len(windows),
        outliers=len(windows) - len(kept),
    )
    return fit, not any(on_line[-NEWEST_WINDOWS:])


def _median(values: list[float]) -> float:
    return sorted(values)[len(values) // 2]
