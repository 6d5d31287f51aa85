"""The real-time part of `make run`: the processes, the live view, and the result.

What stands for other machines (the device, the robot that publishes) gets FIFO below the daemon's if that is allowed.
Outside the demonstration they do not share the daemon's processors.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, TypeVar

import numpy as np
from judge.following import PULSE_N, RATE_HZ, Tracking, tracking, with_approach
from machines.host import Host, HostWatch
from machines.own import own_machine

from tormag_lab.arrays import Array
from tormag_lab.human_pulse import pulse_profile
from tormagd.control.safety.codes import Fault
from tormagd.ctl.processes import begun, end, first_line, is_linked, processor_s
from tormagd.record.reader import RecordingError, Shown as Seen, read_recording
from tormagd_client import Client, ClientError, UnreachableError
from tormagd_client.messages import MessageError, Telemetry

Found = TypeVar("Found")
RUN_DIR = Path("run/demo")
RECORDING = RUN_DIR / "pulse.mcap"
ADDRESS = "ipc://run/demo/{}"
DAEMON_FIFO = 50
DEVICE_FIFO, PUBLISHER_FIFO = DAEMON_FIFO - 10, DAEMON_FIFO - 20
CONFIG = f"""scene = "{{scene}}"

[device]
backend = "can"
port = "{{port}}"

[device.options]
interface = "tormagsim"

[endpoints]
setpoint = "{ADDRESS.format("setpoint")}"
telemetry = "{ADDRESS.format("telemetry")}"
control = "{ADDRESS.format("control")}"
recording = "{ADDRESS.format("recording")}"

[realtime]
fifo_priority = {DAEMON_FIFO}  # each is refused where it is not allowed; then the log says so
lock_memory = true
"""
CTL = ("-m", "tormagd.ctl.main", "--config", str(RUN_DIR / "tormagd.toml"), "--json", "--wait", "60")
MIN_N, MAX_N = PULSE_N
PULSE_S = 20.0
RAMP_S, HOLD_S = 1.0, 3.0
"Approach to the pulse's first force, and a hold there in which the trim learns this device."
PULSE_START_S = RAMP_S + HOLD_S
START_N = 0.6
LOOK_S = 0.2
PATIENCE_S = 60.0
"For a start on a busy machine; only a failure waits so long."
ANSWER_S = 5.0
BEFORE_FAULT_S = 1.0
"A stall explains a fault only if it ended less than this before the fault was seen."
OF_TIME = frozenset(
    {
        Fault.HOST_STALL,
        Fault.LINK_LOST,
        Fault.LINK_DEGRADED,
        Fault.MEASUREMENT_STALE,
        Fault.SENSE_STALE,
        Fault.STATUS_STALE,
        Fault.CLOCK,
        Fault.FOLLOWING_ERROR,
        Fault.PLAN_FAILED,
        Fault.DEVICE_COMMAND_TIMEOUT,
        Fault.DEVICE_NOT_RUNNING,
    }
)
"""Faults by which daemon or device protect themselves from one that stands still, as a search beside the plans may."""


OUT_OF_TIME = frozenset({"not_fresh", "timeout", "not_begun", "not_homed"})
"""Why a device could not be homed and enabled when something came too late."""


class ShowError(Exception):
    def __init__(self, cause: str, remedy: str, is_of_time: bool = False) -> None:
        super().__init__(f"{cause}; {remedy}")
        self.cause = cause
        self.time_s = time.monotonic()
        self.is_of_time = is_of_time


class Shown(NamedTuple):
    time_s: Array
    asked_N: Array
    rendered_N: Array
    gap_mm: Array
    status: dict[str, Any]
    limits: dict[str, float]
    exit_codes: dict[str, int]
    kept: float
    worst_stall_ms: float
    host: Host
    core_share: float
    plant: str = "sample 1"


class Aborted(NamedTuple):
    """What ended the show early, and what the host took just before."""

    error: ShowError
    host: Host


def profile(duration_s: float = PULSE_S) -> tuple[Array, Array]:
    return with_approach(*pulse_profile(duration_s, MIN_N, MAX_N, RATE_HZ), START_N, RAMP_S, HOLD_S)


def scored(time_s: Array, asked_N: Array, rendered_N: Array) -> Tracking:
    pulse = time_s >= PULSE_START_S
    return tracking(asked_N[pulse], rendered_N[pulse])


def show(times_s: Array, forces_N: Array, scene: str = "pulse", plant: str = "sample_1") -> Shown | Aborted:
    return staged(lambda watched: play(watched, times_s, forces_N, scene, plant))


def staged(played: Callable[[HostWatch], Found]) -> Found | Aborted:
    """Run a show in an empty folder, with the host watched; `played` may raise ShowError."""
    shutil.rmtree(RUN_DIR, ignore_errors=True)
    RUN_DIR.mkdir(parents=True)
    with (RUN_DIR / "bare_timer.log").open("w") as log, HostWatch(DAEMON_FIFO + 1, log) as watched:
        began_s = time.monotonic()
        try:
            return played(watched)
        except ShowError as error:
            watched.end()
            until_s = early_end(error.time_s)
            host = watched.between(max(began_s, until_s - BEFORE_FAULT_S), until_s)
            return Aborted(error, host)


class Rig(NamedTuple):
    """An enabled device, its daemon and its recorder; `power_on_s` is the device's, CLOCK_MONOTONIC."""

    simulator: "subprocess.Popen[str]"
    daemon: "subprocess.Popen[str]"
    recorder: "subprocess.Popen[str]"
    client: Client
    power_on_s: float

    def end(self) -> dict[str, int]:
        return {
            "recorder": end(self.recorder, signal.SIGINT),
            "tormagd": end(self.daemon),
            "simulator": end(self.simulator),
        }


def start(stack: contextlib.ExitStack, name: str, *arguments: str, is_read: bool = False) -> "subprocess.Popen[str]":
    return begun(stack, RUN_DIR / f"{name}.log", *arguments, is_read=is_read)


def enabled(stack: contextlib.ExitStack, watched: HostWatch, scene: str, *device: str) -> Rig:
    options = ("--can", "--seed", "1", "--truth", str(RUN_DIR / "truth.csv"), *device)
    simulator = start(stack, "simulator", *own_machine(DEVICE_FIFO, "tormagd.simulation", *options), is_read=True)
    port, power_on_s = first_line(simulator), time.monotonic()
    if not port:
        raise ended("simulator")
    watched.wait_for("simulated device", simulator.pid)
    config = RUN_DIR / "tormagd.toml"
    config.write_text(CONFIG.format(port=port, scene=scene))
    daemon = start(stack, "tormagd", "-m", "tormagd.daemon.main", "--config", str(config))
    watched.wait_for("daemon", daemon.pid)
    # from the first tick on: it also says how a show went that ended early
    recorder = start(stack, "recorder", *CTL, "record", str(RECORDING))
    client = stack.enter_context(Client.local(ADDRESS.format("").removeprefix("ipc://").rstrip("/"), ANSWER_S))
    if not is_linked(client, daemon, PATIENCE_S):
        if daemon.poll() is not None:
            raise ended("tormagd")
        cause = f"the daemon did not reach its device within {PATIENCE_S:.0f} s"
        raise ShowError(cause, f"look at the logs in {RUN_DIR}", is_of_time=True)
    arm(client)
    return Rig(simulator, daemon, recorder, client, power_on_s)


def play(watched: HostWatch, times_s: Array, forces_N: Array, scene: str, plant: str) -> Shown:
    rows, formats = np.column_stack([times_s, forces_N]), ("%.4f", "%.5f")
    np.savetxt(RUN_DIR / "pulse.csv", rows, formats, delimiter=",", header="t_s,force_N", comments="")
    with contextlib.ExitStack() as stack:
        rig = enabled(stack, watched, scene, "--plant", plant)
        client, pid = rig.client, rig.daemon.pid
        before, start_s, before_s = status(client), time.monotonic(), processor_s(pid)
        robot = own_machine(PUBLISHER_FIFO, *CTL[1:], "send", str(RUN_DIR / "pulse.csv"), "--rate", str(RATE_HZ))
        publisher = start(stack, "publisher", *robot, is_read=True)
        limits = watch(lambda: publisher.poll() is not None, rig.daemon, client, float(times_s[-1]))
        printed, _ = publisher.communicate(timeout=PATIENCE_S)
        after, end_s = status(client), time.monotonic()
        core_share = (processor_s(pid) - before_s) / (end_s - start_s)
        raise_fault(after)
        exit_codes = {"publisher": publisher.returncode, **rig.end()}
    answer = json.loads(printed)
    if not answer["ok"]:
        raise ShowError(f"the publisher: {answer['error']['message']}", answer["error"]["hint"], is_of_time=True)
    watched.end()
    truth = told_truth()
    try:
        moments_s = [tick["monotonic_s"] for tick in ticks() if start_s <= tick["monotonic_s"] <= end_s]
    except RecordingError as error:
        raise unreadable(error) from error
    axis = (truth["t_ns"] - answer["result"]["start_ns"]) * 1e-9
    inside = (axis >= times_s[0]) & (axis <= times_s[-1])
    if len(moments_s) < 2 or not inside.any():
        raise ShowError("nothing was recorded", f"look at the logs in {RUN_DIR}", is_of_time=True)
    first, last = before["rates"]["control"], after["rates"]["control"]
    runs, merged = last["runs"] - first["runs"], last["merged"] - first["merged"]
    return Shown(
        time_s=axis[inside],
        asked_N=np.interp(axis[inside], times_s, forces_N),
        rendered_N=truth["force_N"][inside],
        gap_mm=truth["gap_mm"][inside],
        status=after,
        limits=limits,
        exit_codes=exit_codes,
        kept=runs / max(runs + merged, 1),
        worst_stall_ms=float(np.diff(moments_s).max()) * 1e3,
        host=watched.between(start_s, end_s),
        core_share=core_share,
        plant=Path(plant).stem.replace("_", " "),
    )


def told_truth() -> Any:
    try:
        return np.genfromtxt(RUN_DIR / "truth.csv", delimiter=",", names=True)
    except (OSError, ValueError) as error:
        raise unreadable(error) from error


def unreadable(error: Exception) -> ShowError:
    return ShowError(f"what was recorded cannot be read: {error}", f"look at the logs in {RUN_DIR}")


class Tick(TypedDict, total=False):
    monotonic_s: float
    faults: tuple[str, ...]


def ticks() -> list[Tick]:
    seen: list[Seen] = []
    read_recording(RECORDING, Tick, seen.append)
    return [each.message for each in seen if each.is_tick and "monotonic_s" in each.message]


def early_end(seen_s: float) -> float:
    """Return when the first fault was latched, at the latest `seen_s`."""
    with contextlib.suppress(RecordingError):
        return next((tick["monotonic_s"] for tick in ticks() if tick.get("faults")), seen_s)
    return seen_s


def ended(name: str) -> ShowError:
    log = RUN_DIR / f"{name}.log"
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
    said = next((line.strip() for line in reversed(lines) if line.strip()), "it said nothing")
    return ShowError(f"the process {name} ended by itself: {said[:200]}", f"all that it said is in {log}")


def arm(client: Client) -> None:
    try:
        client.arm(PATIENCE_S, lambda step: print(f"arm: {step}"))
    except ClientError as error:
        raise_fault(status(client))
        is_late = isinstance(error, UnreachableError) or error.code in OUT_OF_TIME
        raise ShowError(error.message, error.hint, is_of_time=is_late) from error


def status(client: Client) -> dict[str, Any]:
    try:
        return client.request("status")
    except ClientError as error:
        raise ShowError(error.message, f"look at {RUN_DIR / 'tormagd.log'}", is_of_time=True) from error


def raise_fault(state: dict[str, Any]) -> None:
    if not state["faults"]:
        return
    fault = Fault(state["faults"][0])
    others = "".join(f", then {code}" for code in state["faults"][1:])
    known = state["fault_details"][0]
    raise ShowError(f"{fault}{others}: {known['cause']}", known["remedy"], is_of_time=fault in OF_TIME)


def watch(
    is_done: Callable[[], bool], daemon: "subprocess.Popen[str]", client: Client, duration_s: float
) -> dict[str, float]:
    """Show the live view until the publisher is done; return the share of telemetry messages with each limit."""
    is_terminal = sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
    held: Counter[str] = Counter()
    seen = 0
    start_s = shown_s = time.monotonic()
    until_s = start_s + duration_s + PATIENCE_S
    while not is_done() and time.monotonic() < until_s:
        if daemon.poll() is not None:
            raise ended("tormagd")
        try:
            arrived = client.telemetry(LOOK_S)
        except MessageError as error:
            print(f"telemetry: {error}", file=sys.stderr)
            continue
        for telemetry in arrived:
            if telemetry.faults:
                if is_terminal:
                    print()
                raise_fault(status(client))
            seen += 1
            held.update(telemetry.limits)
        now_s = time.monotonic()
        if arrived and now_s - shown_s >= (0.1 if is_terminal else 1.0):
            shown_s = now_s
            line = live_line(arrived[-1], now_s - start_s, duration_s)
            print(f"\r\x1b[K{line}" if is_terminal else line, end="" if is_terminal else "\n", flush=True)
    if is_terminal:
        print()
    if not is_done():
        raise ShowError(
            f"the publisher was not done {PATIENCE_S:.0f} s after the pulse's end",
            f"look at the logs in {RUN_DIR}",
            True,
        )
    return {limit: count / max(seen, 1) for limit, count in held.items()}


COLUMNS = 79
"One less than the narrowest usual terminal has: a full line would wrap there."


def live_line(telemetry: Telemetry, elapsed_s: float, duration_s: float) -> str:
    """Return one line: a bar of the measured force with a mark where it was asked, gap, and the limits that fit."""
    width, most = 18, 2.0
    measured, asked = telemetry.measured_cf or 0.0, telemetry.setpoint_cf or 0.0
    shown = "-" if telemetry.setpoint_cf is None else f"{asked:.2f}"
    filled = round(min(max(measured / most, 0.0), 1.0) * width)
    bar = list("#" * filled + "-" * (width - filled))
    bar[min(round(asked / most * width), width - 1)] = "|"
    line = (
        f"{min(elapsed_s, duration_s):4.1f}/{duration_s:.0f} s [{''.join(bar)}] asked {shown:>4s} "
        f"got {measured:4.2f} N {telemetry.gap_mm or 0.0:4.1f} mm"
    )
    if telemetry.operating_state != "ENABLED":
        line += f" {telemetry.operating_state}"
    for number, limit in enumerate(telemetry.limits):
        more = f" +{len(telemetry.limits) - number}"
        is_last = number == len(telemetry.limits) - 1
        if len(line) + 1 + len(limit) + (0 if is_last else len(more)) > COLUMNS:
            return line + more
        line += f" {limit}"
    return line
