"""Plants faults into safety, governor, step and link, one at a time, and says which of them the tests catch.

The checkout is never touched: sources and tests are copied to a temporary folder and run interpreted there, the tests
of the file that was changed only, until the first fails. A planted fault that survives its quick tests meets the slow
ones too. Exit status 0 where at least LEAST_CAUGHT are caught.
"""

import argparse
import contextlib
import json
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

ROOT = Path(__file__).parents[1]
LEAST_CAUGHT = 0.9
COPIED = ("tormagd", "firmware_protocol", "tests", "tools", "docs", "pyproject.toml", "setup.py")
STATE, CODES = "tormagd/safety/operating_state.py", "tormagd/safety/codes.py"
STEP, GOVERNOR, LINK = "tormagd/control/step.py", "tormagd/control/governor.py", "tormagd/hardware/link.py"
SIGHT, PLAUSIBLE, HOMING, HANDLE = (f"tormagd/control/{name}.py" for name in ("sight", "plausible", "homing", "handle"))
TESTS = {
    STATE: ("tests/safety",),
    CODES: ("tests/safety",),
    STEP: ("tests/control/test_step.py",),
    SIGHT: ("tests/control/test_step.py",),
    PLAUSIBLE: ("tests/control/test_step.py",),
    HOMING: ("tests/control/test_homing.py", "tests/control/test_step.py"),
    HANDLE: ("tests/control/test_handle.py",),
    GOVERNOR: ("tests/control/test_governor.py",),
    LINK: ("tests/hardware/test_link.py",),
}
SLOW = (
    "TestOperating or any_history or stalls_that_the_device or stays_in_the_gap_range or nan_never or wraps_are "
    "or second_host or no_loss_of_force"
)
"Tests that take seconds each; they are asked last."
QUICK = f"not ({SLOW})"


class Planted(NamedTuple):
    """One fault: a text that stands once in a file, what it becomes, and what that would do."""

    file: str
    old: str
    new: str
    why: str


PLANTED = (
    # the table of operating states
    Planted(
        STATE, "Transition(Event.PAUSE, ENABLED, PAUSED,", "Transition(Event.PAUSE, ENABLED, ENABLED,", "pause goes on"
    ),
    Planted(
        STATE, "Transition(Event.RESUME, PAUSED, ENABLED,", "Transition(Event.RESUME, PAUSED, PAUSED,", "no resuming"
    ),
    Planted(
        STATE,
        "Transition(Event.DISABLE, ENABLED, DISABLED, _OPENS, (CONNECTED,), RETRACT)",
        "Transition(Event.DISABLE, ENABLED, DISABLED, _OPENS, (CONNECTED,))",
        "a disabled gap stays closed",
    ),
    Planted(
        STATE,
        "*[Transition(Event.FAULT, source, FAULTED, _OPENS, (), RETRACT)",
        "*[Transition(Event.FAULT, source, FAULTED, _OPENS, ())",
        "a fault opens nothing",
    ),
    Planted(
        STATE,
        "*[Transition(Event.FAULT, source, FAULTED,",
        "*[Transition(Event.FAULT, source, DISABLED,",
        "a fault is not shown, and enable is not refused",
    ),
    Planted(
        STATE,
        "Transition(Event.CLEAR_FAULT, FAULTED, DISABLED, _CLEARED,",
        "Transition(Event.CLEAR_FAULT, FAULTED, ENABLED, _CLEARED,",
        "armed by clearing",
    ),
    Planted(
        STATE,
        'Refusal(Event.ENABLE, FAULTED, "fault", CLEAR_FIRST)',
        'Transition(Event.ENABLE, FAULTED, ENABLED, "armed", READY)',
        "armed in FAULT",
    ),
    Planted(
        STATE,
        "(CONNECTED, HOMABLE, NOT_BUSY),",
        "(CONNECTED, NOT_BUSY),",
        "a device that has latched is asked to home",
    ),
    Planted(
        STATE, 'return "" if present.homed else "the', 'return "" if present.fresh else "the', "enabled without a zero"
    ),
    Planted(STATE, "if state.needs_homing else", "if False else", "lost positions are believed"),
    Planted(STATE, 'return "" if present.fresh else', 'return "" if True else', "enabled on old measurements"),
    Planted(STATE, "if present.sensor_doubted else", "if False else", "enabled with a broken sensor"),
    Planted(
        STATE, "present.requested_N <= present.neutral_N:", "present.requested_N < 1e9:", "a force leaps at enable"
    ),
    Planted(
        STATE,
        "present.requested_N <= present.neutral_N:",
        "not present.requested_N > present.neutral_N:",
        "NaN is neutral",
    ),
    Planted(STATE, "present.apart_mm <= present.most_apart_mm:", "True:", "enabled with skewed carriages"),
    Planted(STATE, "present.round_trip_s <= present.most_round_trip_s:", "True:", "enabled on a wire that swings"),
    Planted(STATE, "if abs(present.clock_drift) <=", "if present.clock_drift <=", "a slow clock is no wrong clock"),
    Planted(STATE, "if present.device_latched else", "if present.busy else", "a latched device is enabled"),
    Planted(STATE, "faults=state.faults + tuple(new),", "faults=tuple(new),", "a second fault hides the first"),
    Planted(STATE, "new.sort(key=_RANK.__getitem__)", "new.sort()", "named in the order of the alphabet"),
    Planted(
        STATE,
        "needs_homing=state.needs_homing or not LOST_POSITION.isdisjoint(new),",
        "needs_homing=not LOST_POSITION.isdisjoint(new),",
        "a second fault gives lost positions back",
    ),
    Planted(STATE, "request_number=self.request_number + 1", "request_number=self.request_number", "no request is new"),
    Planted(
        STATE,
        "return state if is_homed or not state.needs_homing else",
        "return state if not is_homed or not state.needs_homing else",
        "a device that never homed again is believed",
    ),
    Planted(
        STATE, "clearing_until_s=now_s + CLEARING_S", "clearing_until_s=now_s", "a cleared fault comes back at once"
    ),
    Planted(
        STATE,
        "state = state.replaced(clearing_until_s=-math.inf)",
        "pass",
        "a fault within half a second of enabling is passed over",
    ),
    Planted(
        STATE,
        "        if not conditions.device_latched:\n            request",
        "        if False:\n            request",
        "CLEAR is asked of nobody",
    ),
    # what is known of the codes
    Planted(CODES, "if not is_host_stall:", "if is_host_stall:", "the host's stall is the device's timeout"),
    Planted(
        CODES,
        "for bit, fault in _BY_DEVICE_FAULT.items() if bit in bits",
        "for bit, fault in _BY_DEVICE_FAULT.items() if bit is bits",
        "two bits at once are none",
    ),
    Planted(
        CODES,
        "if self.position is Position.KEPT else",
        "if self.position is not Position.LOST_HERE else",
        "the page forgets the homing",
    ),
    # the step
    Planted(STEP, "if not -math.inf < total < math.inf:", "if False:", "NaN is driven"),
    Planted(STEP, "min(max(left_duty, -most), most),", "left_duty,", "a duty over its limit on a low supply"),
    Planted(
        STEP,
        "if self._needs_sensor and at_s - measurement.sensed_s > SENSE_FAULT_S:",
        "if False:",
        "no Sense, no fault",
    ),
    Planted(STEP, "if at_s - measurement.reported_s > STATUS_FAULT_S:", "if False:", "no Status, no fault"),
    Planted(STEP, "            if is_old:\n", "            if False:\n", "a loop around an old measurement"),
    Planted(STEP, "if measurement.link.round_trip_s > self._too_slow_s:", "if False:", "carriages swing"),
    Planted(
        STEP,
        "if abs(measurement.link.clock_drift) > CLOCK_FAULT:",
        "if measurement.link.clock_drift > CLOCK_FAULT:",
        "a slow clock is driven on",
    ),
    Planted(
        STEP,
        "abs(estimate.skew_mm) > self._skew_fault_mm",
        "estimate.skew_mm > self._skew_fault_mm",
        "skew to one side only",
    ),
    Planted(STEP, "if state.straying_s > self._following_time_s:", "if False:", "a gap that does not follow"),
    Planted(STEP, "if state.over_s > OVER_FAULT_S and self._slides:", "if False:", "too much force for ever"),
    Planted(STEP, "if state.over_s > OVER_HELD_S:", "if False:", "too much force does not open"),
    Planted(
        STEP,
        "if self._needs_sensor and plan.sensor_doubted_s > SENSOR_FAULT_S:",
        "if False:",
        "a broken sensor for ever",
    ),
    Planted(
        STEP, "        if is_still:\n            faults", "        if False:\n            faults", "a blocked carriage"
    ),
    Planted(
        STEP, "not faults and now_s - state.enabled_s > STARTING_S", "not faults and False", "a device that left RUN"
    ),
    Planted(
        STEP, "> (WENT_AGAINST_S if is_skewed or is_still else OPPOSED_S):", "> math.inf:", "a motor the wrong way"
    ),
    Planted(STEP, "if measurement.reported_s > leap.seen_s:", "if False:", "a leap is held for ever"),
    Planted(STEP, "if sight.is_blind or leap is not None:", "if sight.is_blind:", "driven on counts that leapt"),
    Planted(STEP, "if sight.is_blind or leap is not None:", "if leap is not None:", "driven blindly"),
    Planted(
        STEP,
        "output = StepOutput(_RUN, 0.0, 0.0, safety",
        "output = StepOutput(_RUN, *state.duties, safety",
        "the last duty is held blindly",
    ),
    Planted(
        STEP,
        "if shown and now_s >= state.safety.clearing_until_s:",
        "if False:",
        "the device's own faults are passed over",
    ),
    Planted(
        STEP, "            safety = latch(safety, (Fault.LINK_LOST,))", "            pass", "a lost link is no fault"
    ),
    Planted(
        STEP,
        "return StepOutput(DriveMode.OFF, 0.0, 0.0, safety.request",
        "return StepOutput(_RUN, 0.0, 0.0, safety.request",
        "RUN while disabled",
    ),
    Planted(
        STEP,
        "within_mm = min(max(max(gap_mm, self._closed_mm), plan.least_gap_mm), self._open_mm)",
        "within_mm = min(max(gap_mm, self._closed_mm), self._open_mm)",
        "closer than this device may",
    ),
    Planted(
        STEP,
        "within_mm = min(max(max(gap_mm, self._closed_mm), plan.least_gap_mm), self._open_mm)",
        "within_mm = gap_mm",
        "beyond the scene's gaps",
    ),
    Planted(
        STEP,
        "age_s = min(max(now_s - plan.time_s, 0.0), CARRY_S)",
        "age_s = max(now_s - plan.time_s, 0.0)",
        "a plan carried on for ever",
    ),
    Planted(
        STEP,
        "            fresh=conditions.fresh and estimate is not None,\n",
        "            fresh=conditions.fresh,\n",
        "enabled without an estimate",
    ),
    Planted(
        STEP,
        "apart_mm=math.inf if estimate is None else abs(estimate.skew_mm)",
        "apart_mm=math.inf if estimate is None else estimate.skew_mm",
        "enabled skewed to one side",
    ),
    Planted(
        STEP,
        "            estimate = first_estimate(measurement, self._home_mm)\n",
        "            estimate = estimate\n",
        "speeds from before homing",
    ),
    Planted(
        STEP,
        "acted = acted.replaced(not_finite=acted.not_finite + 1)",
        "acted = acted.replaced()",
        "NaN is not counted",
    ),
    # sight, plausibility, homing
    Planted(SIGHT, "if stall_s > blind_s:", "if False:", "a stall is not seen"),
    Planted(
        SIGHT,
        "return self.is_blind and now_s - self.stalled_s < 2.0",
        "return False and now_s - self.stalled_s < 2.0",
        "a stall is a stale measurement",
    ),
    Planted(
        PLAUSIBLE,
        "if -most_mm <= left_mm <= most_mm and -most_mm <= right_mm <= most_mm:",
        "if -most_mm <= left_mm <= most_mm:",
        "the right encoder leaps",
    ),
    Planted(
        PLAUSIBLE,
        "if -most_mm <= left_mm <= most_mm and -most_mm <= right_mm <= most_mm:",
        "if left_mm <= most_mm and right_mm <= most_mm:",
        "leaps towards closed",
    ),
    Planted(PLAUSIBLE, "home_mm if is_left_open else least_mm", "least_mm", "a switch that is stuck"),
    Planted(
        HOMING,
        "or right_mm - measurement.right_mm > BACKS_OFF_MM:",
        "and right_mm - measurement.right_mm > BACKS_OFF_MM:",
        "one motor homes the wrong way",
    ),
    Planted(HOMING, "elif now_s - homing.began_s > LONGEST_S:", "elif False:", "homing for ever"),
    Planted(HOMING, "if switches != _BOTH_OPEN:", "if False:", "homed without its switches"),
    Planted(HOMING, "elif over_s > OVER_S:", "elif False:", "homing presses"),
    # the governor
    Planted(GOVERNOR, "if age > setpoint.valid_for_s:", "if False:", "a force held for ever"),
    Planted(
        GOVERNOR,
        "asked_N = min(max(setpoint.force_N, self._least_N), self._most_N)",
        "asked_N = max(setpoint.force_N, self._least_N)",
        "over the scene's greatest force",
    ),
    Planted(
        GOVERNOR,
        "within = [min(max(force_N, least), most) for force_N in path]",
        "within = path",
        "forecasts beyond the range",
    ),
    Planted(GOVERNOR, "- self._release_N_s * elapsed, 0.0)", "- 1e9 * elapsed, 0.0)", "a force vanishes at once"),
    Planted(GOVERNOR, "- self._release_N_s * elapsed, 0.0)", ", 0.0)", "a silent publisher's force stays"),
    Planted(GOVERNOR, "is_passing = abs(left_N) > step_N", "is_passing = False", "a leap to another source's force"),
    Planted(GOVERNOR, "reasons = (*reasons, Limit.OTHER_SOURCE)", "reasons = reasons", "another source is not named"),
    Planted(GOVERNOR, "slope, learned = 0.0, NOTHING_LEARNED", "pass", "one publisher's beat is another's"),
    Planted(GOVERNOR, "return highest_N, (*reasons, Limit.F_MAX)", "return highest_N, reasons", "F_MAX is not named"),
    Planted(
        GOVERNOR, "if allowed_N == setpoint_N else (Limit.RANGE,)", "if True else (Limit.RANGE,)", "RANGE is not named"
    ),
    Planted(GOVERNOR, "min(at_s - ends_s, AHEAD_S, ends_s)", "(at_s - ends_s)", "a preview goes on for ever"),
    Planted(GOVERNOR, "min(begins_s + after_s, AHEAD_S)", "(begins_s + after_s)", "a slope goes on for ever"),
    # the handle
    Planted(
        HANDLE, "abs(handle_mm - self.at_mm) > STANDS_MM:", "handle_mm - self.at_mm > STANDS_MM:", "back is no motion"
    ),
    Planted(HANDLE, " and model_N - least_model_N > MODEL_RISES_N", "", "a sensor that leaps is a lost handle"),
    Planted(HANDLE, "still_s < SETTLES_S or force_N", "force_N", "a handle that comes to rest is a lost one"),
    Planted(HANDLE, "self.is_lost or has_risen", "has_risen", "a lost handle is told for an instant"),
    # the link
    Planted(LINK, "% 256 < OVERTAKEN:", "% 256 < 1:", "a State that was overtaken is a measurement"),
    Planted(
        LINK, "self.state is _RUNNING and now_s - self._heard_s > SILENT_S", "False", "a silent device is not lost"
    ),
    Planted(LINK, "if identity.schema_hash == SCHEMA_HASH:", "if True:", "any firmware is driven"),
    Planted(
        LINK,
        "known is not None and known.serial_number != identity.serial_number",
        "False",
        "another device goes on as this one",
    ),
    Planted(
        LINK,
        "elif self._status.command_nonce != 0 and status.command_nonce == 0:",
        "elif False:",
        "a reset is not seen",
    ),
    Planted(LINK, "now_s - self._requested_s > GIVE_UP_S", "False", "a Home as a surprise"),
    Planted(LINK, "if self._request is not DeviceRequest.RETRACT and now_s", "if now_s", "opening is given up"),
    Planted(
        LINK,
        "if self._request is not DeviceRequest.RETRACT:  # opening",
        "if True:  # opening",
        "a reset forgets to open",
    ),
    Planted(
        LINK,
        "return nonce % (FIRST_NONCE - 1) + 1",
        "return nonce % FIRST_NONCE + 1",
        "a command with the Hello's number",
    ),
    Planted(
        LINK,
        "return (value - previous + span / 2.0) % span - span / 2.0",
        "return value - previous",
        "a wrap is a leap",
    ),
    Planted(
        LINK,
        "        if not has_new_origin:\n            self._told = status",
        "        self._told = status",
        "homed with the position of before",
    ),
    Planted(
        LINK,
        "self._counter = (self._counter + 1) % 256",
        "self._counter = (self._counter + 2) % 256",
        "Drives are counted by twos",
    ),
    Planted(
        LINK,
        "            self._request_due_s = now_s + REPEAT_S\n            messages",
        "            self._request_due_s = now_s + 1e9\n            messages",
        "a lost command is not repeated",
    ),
    Planted(
        LINK,
        "elif self._request is DeviceRequest.RETRACT and status.mode is DeviceMode.LATCHED:",
        "elif False:",
        "RETRACT is repeated to a latched device for ever",
    ),
    Planted(
        LINK,
        "if self._status is None or self._sense is None:\n            return",
        "if self._status is None:\n            return",
        "measured without a Sense",
    ),
)


def main() -> int:
    """Plants all or those with TEXT in what they do; returns 1 where too few are caught."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default="", metavar="TEXT", help="those with this in their file or in what they do")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    chosen = [each for each in PLANTED if options.only in each.file or options.only in each.why]
    if not chosen:
        parser.error(f"--only {options.only!r}: no planted fault has this")
    with tempfile.TemporaryDirectory(prefix="planted-") as folder:
        place = Path(folder)
        copy(place)
        healthy = [file for file in TESTS if any(each.file == file for each in chosen) and fails(place, file, QUICK)]
        if healthy:
            raise SystemExit(f"the tests of {', '.join(healthy)} fail without a planted fault")
        caught = []
        for each in (progress := tqdm(chosen, desc="planted faults", unit="fault", disable=not sys.stderr.isatty())):
            progress.set_postfix_str(each.why[:40])
            caught.append(plant(place, each))
            tqdm.write(f"{'caught' if caught[-1] else 'SURVIVED'}: {each.file}: {each.why}", file=sys.stderr)
    survived = [each for each, is_found in zip(chosen, caught, strict=True) if not is_found]
    share = 1.0 - len(survived) / len(chosen)
    figures = {
        "planted": len(chosen),
        "caught": len(chosen) - len(survived),
        "survived": [{"file": each.file, "old": each.old, "new": each.new, "why": each.why} for each in survived],
        "passed": share >= LEAST_CAUGHT,
    }
    if options.json:
        print(json.dumps(figures))
    else:
        for each in survived:
            print(f"survived: {each.file}: {each.why}\n  - {each.old}\n  + {each.new}")
        print(f"{figures['caught']} of {len(chosen)} planted faults caught, {share:.0%}")
    return 0 if figures["passed"] else 1


def copy(place: Path) -> None:
    """Sources and tests, without what was compiled."""
    ignored = shutil.ignore_patterns("*.so", "__pycache__", "core.json", ".hypothesis")
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, place / name, ignore=ignored)
        else:
            shutil.copy(source, place / name)


def changed(text: str, each: Planted) -> str:
    """The source with the fault. Raises ValueError where its text does not stand there once."""
    found = text.count(each.old)
    if found != 1:
        raise ValueError(f"{each.file}: {each.old!r} stands there {found} times: allowed is once")
    return text.replace(each.old, each.new)


def plant(place: Path, each: Planted) -> bool:
    """Whether the tests catch it. The copy is as before afterwards."""
    path = place / each.file
    healthy = path.read_text(encoding="utf-8")
    write(path, changed(healthy, each))
    try:
        return is_caught(place, each.file)
    finally:
        write(path, healthy)


def write(path: Path, text: str) -> None:
    """Writes a source, and forgets its bytecode: a change within a second, of the same length, would not be noticed."""
    path.write_text(text, encoding="utf-8")
    for bytecode in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
        bytecode.unlink()


def is_caught(place: Path, file: str) -> bool:
    """Whether a test of that file fails, the quick ones first."""
    return fails(place, file, QUICK) or fails(place, file, SLOW)


def fails(place: Path, file: str, chosen: str) -> bool:
    """Runs the tests in a fork: what they import from elsewhere is loaded once, ours anew every time."""
    child = os.fork()
    if child:
        _, status = os.waitpid(child, 0)
        return os.waitstatus_to_exitcode(status) not in (0, 5)  # 5: none were chosen
    code = 1
    with contextlib.suppress(BaseException):
        code = run(place, file, chosen)
    os._exit(code)


def run(place: Path, file: str, chosen: str) -> int:
    """In the child: the tests of that file in the copy, interpreted, until the first fails."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    os.chdir(place)
    os.environ |= {"TORMAG_COMPILED": "0", "PYTHONPATH": str(place)}
    sys.path[:] = [
        str(place),
        *(entry for entry in sys.path if Path(entry or ".").resolve() not in (ROOT, ROOT / "tools")),
    ]
    import pytest

    return int(pytest.main(["-q", "-x", "-p", "no:cacheprovider", "-W", "ignore", "-k", chosen, *TESTS[file]]))


if __name__ == "__main__":
    import hypothesis.stateful  # noqa: F401
    import msgspec  # noqa: F401
    import numpy  # noqa: F401
    import pytest  # noqa: F401

    sys.exit(main())
