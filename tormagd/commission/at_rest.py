"""Steps without force: link, host, supply, homing, switches, weight, and the way back."""

import numpy as np

from tormagd.commission.carriage_findings import SIDES
from tormagd.commission.finding import Finding, finding
from tormagd.commission.procedure import PLACES, Columns, Course, Known, Row, given, watch

REST_S = 3.0
BEGINS_S, HOMING_S = 2.0, 15.0
OPENING_S = 12.0
HUNG_S, SWINGS_S, SECOND_S = 60.0, 3.0, 17.0
TOLD_S = 0.3
"By then a device that opens has said so."
PLACE_MM = (-0.3, 0.3)
"Allowed places of a switch: twice what the weakest motors run on while they brake."
ANY_STATE = ("DISABLED", "ENABLED", "PAUSED")
LINE = "look at the cable and at tormagctl firmware; guide bring-up, The link to the device"
SWITCH = "look at the switch, its cable and the coupling between motor and screw"


def link(known: Known) -> Course[list[Finding]]:
    """Watch a device for REST_S without a setpoint, in any state but FAULT."""
    ticks = yield from watch(REST_S, states=ANY_STATE)
    steps_s = np.diff(ticks["monotonic_s"])
    lost = ticks["link_unanswered"] + ticks["link_damaged"]
    nominal_V = known.config.motor.supply_V
    return [
        finding("round trip", ticks["link_round_trip_s"], "ms", (0.0, 3.0), LINE, 1e3),
        finding(
            "periods with the device's answer",
            (np.diff(ticks["device_time_s"]) > 0.0).astype(np.float64),
            "%",
            (80.0, 100.0),
            LINE,
            100.0,
        ),
        finding("messages lost or damaged", lost, "%", (0.0, 1.0), LINE, 100.0),
        finding(
            "periods kept",
            (steps_s < 1.5 * known.period_s).astype(np.float64),
            "%",
            (90.0, 100.0),
            "tormagctl doctor --measure",
            100.0,
        ),
        finding(
            "supply",
            ticks["supply_V"],
            "V",
            (0.92 * nominal_V, 1.08 * nominal_V),
            "set the supply to motor.supply_V, or state what it is",
        ),
        finding(
            "device's temperature", ticks["device_temperature_C"], "°C", (0.0, 50.0), "let it cool; look at its air"
        ),
    ]


def homing(_known: Known) -> Course[list[Finding]]:
    yield from given("disable", lambda row: bool(row[_STATE] == "DISABLED"), BEGINS_S)
    yield from watch(TOLD_S, states=ANY_STATE)
    yield from given("", _is_idle, OPENING_S)
    yield from given("home", lambda row: bool(row[_MODE] == "HOMING"), BEGINS_S)
    ticks = yield from given("", lambda row: _is_idle(row) and "HOMED" in row[_SWITCHES], HOMING_S)
    remedy = "compare with the conformance report: motors, encoders and switches"
    at = [
        finding(f"{side} switch, homed, at", ticks[f"device_{side}_mm"][-1], "mm", PLACE_MM, SWITCH) for side in SIDES
    ]
    return [_lasts("homing takes", ticks, 12.0, remedy), *at]


def weight(known: Known) -> Course[list[Finding]]:
    """Have a weight hung from the sensor, and then another one like it, if there is one."""
    assert known.weight_N is not None, "the step is left out without one"
    begins_N, hung_N = (yield from _level_N()), 0.4 * known.weight_N

    def is_hung(row: Row) -> bool:
        return row[_FORCE] is not None and bool(abs(row[_FORCE] - begins_N) > hung_N)

    yield from given("", is_hung, HUNG_S)
    levels_N = [begins_N, (yield from _level_N(SWINGS_S)), (yield from _level_N(SECOND_S))]
    first, second = np.abs(np.diff(levels_N)) / known.weight_N
    found = [finding("sensor's gain, by the weight", first, "", (0.95, 1.05), "calibrate the sensor, or replace it")]
    if second > 0.4:
        bent = finding("sensor's second weight over the first", second / first, "", (0.95, 1.05), "replace the sensor")
        found.append(bent)
    return found


def _level_N(after_s: float = 0.0) -> Course[float]:
    yield from watch(after_s, states=ANY_STATE)
    ticks = yield from watch(REST_S, states=ANY_STATE)
    return float(np.nanmean(ticks["device_force_N"]))


def way_back(_known: Known) -> Course[list[Finding]]:
    """Disable the device, which opens the gap, and compare its switches with homing's."""
    ticks = yield from given("disable", _is_idle, OPENING_S)
    at = []
    for side in SIDES:
        is_closed = np.array([f"{side.upper()}_OPEN" in switches for switches in ticks["device_switches"]])
        place_mm = ticks[f"device_{side}_mm"][np.argmax(is_closed)] if is_closed.any() else np.nan
        at.append(finding(f"{side} switch, after the forces, at", place_mm, "mm", PLACE_MM, SWITCH))
    drift = ticks["device_clock_drift"][-1]
    clock = finding("device's clock runs fast by", drift, "ppm", (-1e3, 1e3), LINE, 1e6)
    return [_lasts("opening takes", ticks, 4.0, "look at the supply, the screws, and what rubs"), *at, clock]


def _lasts(name: str, ticks: Columns, most_s: float, remedy: str) -> Finding:
    return finding(name, ticks["monotonic_s"][-1] - ticks["monotonic_s"][0], "s", (0.0, most_s), remedy)


_STATE, _MODE, _SWITCHES, _FORCE = (
    PLACES[name] for name in ("operating_state", "device_mode", "device_switches", "device_force_N")
)


def _is_idle(row: Row) -> bool:
    return bool(row[_MODE] == "IDLE")
