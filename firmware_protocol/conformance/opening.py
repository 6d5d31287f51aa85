"""Checks of opening from the whole stroke: how fast, how far, and how it ends."""

from collections import deque
from collections.abc import Callable
from typing import Final

from firmware_protocol.codec import DeviceFault, DeviceMode, Retract, State
from firmware_protocol.conformance.check import Hazard, check
from firmware_protocol.conformance.host import (
    NO_FAULT,
    OPENED_S,
    SEEN_S,
    TIME_SPAN_S,
    Beat,
    Host,
    Unmet,
    places,
    shown,
    unless,
)

PAGE: Final = "Opening"
NEARLY_MM: Final = 1.25
"An opening from the whole stroke begins this far before the closed switch."
MIN_SHARE: Final = 0.6
MAX_SHARE: Final = 1.15
"""Bounds of a carriage's speed as shares of the device's opening speed: its mean without the ends, and its most."""
ENDS_MM: Final = 3.0
CLOSING_DUTY: Final = -0.5
WINDOW: Final = 50
FULLY: Final = f"all the way at {MIN_SHARE:g} to {MAX_SHARE:g} of the device's speed; "
NEARLY: Final = f"in RUN, {NEARLY_MM:g} mm from the closed switches, "


def opens_fully(host: Host, fault: DeviceFault, beat: Beat = Beat.OFF) -> str:
    """Watch a device open, and judge each carriage's speed on the device's clock."""
    host.forget()
    starts_mm = places(host.last(State))
    host.until(host.is_resting, OPENED_S, beat)
    rows: list[tuple[float, tuple[float, float]]] = []
    time_s, before_s = 0.0, -1.0
    for _, state in host.all_of(State):
        time_s += (state.device_time_s - before_s) % TIME_SPAN_S if rows else 0.0
        before_s = state.device_time_s
        rows.append((time_s, places(state)))
    speeds = [_speeds(rows, side, starts_mm[side]) for side in (0, 1)]
    means, mosts = [mean for mean, _ in speeds], [most for _, most in speeds]
    seen = f"{min(means):.1f} mm/s on the way, {max(mosts):.1f} at most"
    is_wrong = min(means) < MIN_SHARE * host.opening_mm_s or max(mosts) > MAX_SHARE * host.opening_mm_s
    mode = DeviceMode.LATCHED if fault else DeviceMode.IDLE
    return host.shows(mode, beat, homed=not fault, opened=True, fault=fault, besides=seen, wrong=is_wrong)


def _speeds(rows: list[tuple[float, tuple[float, float]]], side: int, start_mm: float) -> tuple[float, float]:
    """Return one carriage's mean speed without ENDS_MM at both ends, and the most over a window."""
    window: deque[tuple[float, float]] = deque(maxlen=WINDOW)
    way: list[tuple[float, float]] = []
    most_mm_s = 0.0
    for time_s, at in rows:
        window.append((time_s, at[side]))
        if len(window) == WINDOW and time_s > window[0][0]:
            most_mm_s = max(most_mm_s, (at[side] - window[0][1]) / (time_s - window[0][0]))
        if start_mm + ENDS_MM < at[side] < -ENDS_MM:
            way.append((time_s, at[side]))
    if len(way) < 2:
        return 0.0, most_mm_s
    return (way[-1][1] - way[0][1]) / (way[-1][0] - way[0][0]), most_mm_s


def _from_inside(host: Host, ends_run: Callable[[], object], fault: DeviceFault, beat: Beat) -> str:
    host.running(host.stroke_mm - NEARLY_MM)
    ends_run()
    if (status := host.next_status(beat)).mode is not DeviceMode.RETRACTING:
        raise Unmet(shown(status))
    return opens_fully(host, fault, beat)


def _lets_go(host: Host) -> None:
    host.pass_time(SEEN_S, Beat.OFF, duty=CLOSING_DUTY)
    unless(host.status.mode is not DeviceMode.RETRACTING, f"Drive OFF with duties: {shown(host.status)}")


@check(
    Hazard.SHUT,
    PAGE,
    f"{NEARLY}Drive OFF, at first with duties of {CLOSING_DUTY:g}",
    f"{FULLY}IDLE, open, HOMED, no fault",
    moves=True,
)
def off_opens_fully(host: Host) -> str:
    return _from_inside(host, lambda: _lets_go(host), NO_FAULT, Beat.OFF)


@check(Hazard.SHUT, PAGE, f"{NEARLY}Retract, Drive RUN going on", f"{FULLY}IDLE, open, HOMED, no fault", moves=True)
def retract_opens_fully(host: Host) -> str:
    return _from_inside(host, lambda: host.obeyed(Retract, Beat.RUN), NO_FAULT, Beat.RUN)


@check(
    Hazard.SHUT,
    "Who says what when, 6",
    f"{NEARLY}no Drive for 0.1 s, then Drive OFF",
    f"{FULLY}LATCHED, open, with COMMAND_TIMEOUT alone",
    moves=True,
)
def silence_opens_fully(host: Host) -> str:
    return _from_inside(host, lambda: host.pass_time(0.1), DeviceFault.COMMAND_TIMEOUT, Beat.OFF)


CHECKS: Final = (off_opens_fully, retract_opens_fully, silence_opens_fully)
