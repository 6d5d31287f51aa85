"""`make run`: a measured human pulse through the whole path, on simulated hardware, in real time.

    publisher --ZeroMQ--> tormagd --serial, a pty--> virtual firmware --> plant

Each part is a process of its own, as it would be beside a console; this one only starts them, watches, and sums up.
What is called rendered is the plant's friction force at the roller, never the controller's prediction.
"""

import concurrent.futures
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import zmq
from demo_figure import draw
from human_pulse import Array, pulse_profile, with_approach
from rehearsal import Case, Rehearsal, rehearse
from tracking import Tracking, tracking

from tormagd.config import Config, load_config
from tormagd.messages import MessageError, Telemetry, decode
from tormagd.scenes.scene import Scene, load_scene

RUN_DIR = Path("run/demo")
LEAST_N, MOST_N = 1.4, 1.7
RATE_HZ = 500
PULSE_S = 20.0
RAMP_S, HOLD_S = 1.0, 3.0
"Approach to the pulse's first force, and a hold there in which the trim learns this device."
START_N = 0.6
THESIS_GAP_SPEED_MM_S = 8.33
CASES = (
    Case("sample 1"),
    Case("sample 2", plant="sample_2"),
    Case("sample 3", plant="sample_3"),
    Case("sample 1, thesis's 8.33 mm/s", gap_speed_mm_s=THESIS_GAP_SPEED_MM_S),
    Case("sample 1, handle stops and reverses", hand="reversing"),
)
CONFIG = """scene = "pulse"

[device]
port = "{port}"

[endpoints]
setpoint = "ipc://run/demo/setpoint"
telemetry = "ipc://run/demo/telemetry"
control = "ipc://run/demo/control"
recording = "ipc://run/demo/recording"

[realtime]
fifo_priority = 50  # refused where it is not allowed; then the log says so
"""


class Shown(NamedTuple):
    """The real-time part: what was asked and rendered, and what the daemon said of itself at the end."""

    time_s: Array
    asked_N: Array
    rendered_N: Array
    gap_mm: Array
    status: dict[str, Any]
    limits: dict[str, float]
    exit_codes: dict[str, int]


def main() -> int:
    """Runs the demonstration; 0 only if tracking, rates and link met what the scene states."""
    started_s = time.monotonic()
    shutil.rmtree(RUN_DIR, ignore_errors=True)
    RUN_DIR.mkdir(parents=True)
    times_s, forces_N = with_approach(*pulse_profile(PULSE_S, LEAST_N, MOST_N, RATE_HZ), START_N, RAMP_S, HOLD_S)
    write_profile(RUN_DIR / "pulse.csv", times_s, forces_N)
    print("A measured human pulse (photoplethysmogram, heartpy) as a force, through the daemon and a simulated device.")
    shown = show(times_s, forces_N)
    config = load_config(RUN_DIR / "tormagd.toml")
    scene = load_scene(config.scene)
    print("The same pulse in virtual time, on the other plant samples:")
    rehearsals = rehearse_all(config, times_s, forces_N)
    return conclude(scene, shown, rehearsals, time.monotonic() - started_s)


def write_profile(path: Path, times_s: Array, forces_N: Array) -> None:
    """A setpoint CSV."""
    rows = (f"{t:.4f},{f:.5f}" for t, f in zip(times_s, forces_N, strict=True))
    path.write_text("t_s,force_N\n" + "\n".join(rows) + "\n")


def show(times_s: Array, forces_N: Array) -> Shown:
    """Starts the processes, plays the profile with a live view, ends them in order."""
    truth_path = RUN_DIR / "truth.csv"
    codes: dict[str, int] = {}
    with contextlib.ExitStack() as stack:
        simulator = stack.enter_context(
            process(
                "simulator",
                "-m",
                "tormagd.simulation",
                "--pty",
                "--plant",
                "sample_1",
                "--seed",
                "1",
                "--truth",
                str(truth_path),
                stdout=subprocess.PIPE,
            )
        )
        assert simulator.stdout is not None
        port = simulator.stdout.readline().strip()
        if not port:
            raise SystemExit(f"the simulator did not start; see {RUN_DIR / 'simulator.log'}")
        (RUN_DIR / "tormagd.toml").write_text(CONFIG.format(port=port))
        daemon = stack.enter_context(process("tormagd", "-m", "tormagd.daemon.main", "--config", config_path()))
        wait_for_daemon(daemon)
        ctl("home")
        print("homed; enabling")
        ctl("enable")
        recorder = stack.enter_context(process("recorder", *CTL, "record", str(RUN_DIR / "pulse.mcap")))
        publisher = stack.enter_context(
            process(
                "publisher",
                *CTL,
                "--json",
                "send",
                str(RUN_DIR / "pulse.csv"),
                "--rate",
                str(RATE_HZ),
                stdout=subprocess.PIPE,
            )
        )
        limits = watch(publisher, PULSE_S + RAMP_S + HOLD_S)
        sent = json.loads(publisher.communicate(timeout=30)[0])["result"]
        status = ctl("status")
        codes["publisher"] = publisher.returncode
        codes["recorder"] = end(recorder, signal.SIGINT)
        codes["tormagd"] = end(daemon, signal.SIGTERM)
        codes["simulator"] = end(simulator, signal.SIGTERM)
    truth = np.genfromtxt(truth_path, delimiter=",", names=True)
    axis = (truth["t_ns"] - sent["start_ns"]) * 1e-9
    inside = (axis >= times_s[0]) & (axis <= times_s[-1])
    asked = np.interp(axis[inside], times_s, forces_N)
    return Shown(axis[inside], asked, truth["force_N"][inside], truth["gap_mm"][inside], status, limits, codes)


CTL = ("-m", "tormagd.ctl.main", "--config", str(RUN_DIR / "tormagd.toml"))


def config_path() -> str:
    """The demonstration's configuration file."""
    return str(RUN_DIR / "tormagd.toml")


@contextlib.contextmanager
def process(name: str, *arguments: str, stdout: int | None = None) -> Iterator["subprocess.Popen[str]"]:
    """A Python child whose messages go to a log file; killed if it is still there at the end."""
    with (RUN_DIR / f"{name}.log").open("w") as log:
        child = subprocess.Popen(
            [sys.executable, *arguments], stdout=log if stdout is None else stdout, stderr=log, text=True
        )
        try:
            yield child
        finally:
            if child.poll() is None:
                child.kill()
            child.wait()


def end(child: "subprocess.Popen[str]", number: signal.Signals) -> int:
    """Sends a signal and waits for the orderly end it asks for."""
    child.send_signal(number)
    try:
        return child.wait(timeout=15)
    except subprocess.TimeoutExpired:
        child.kill()
        return child.wait()


def ctl(*arguments: str) -> dict[str, Any]:
    """Runs tormagctl and gives its answer. Raises SystemExit with what it said where it failed."""
    done = subprocess.run(
        [sys.executable, *CTL, "--json", *arguments], capture_output=True, text=True, timeout=60, check=False
    )
    if done.returncode:
        raise SystemExit(f"tormagctl {' '.join(arguments)}: {done.stderr.strip() or done.stdout.strip()}")
    answer: dict[str, Any] = json.loads(done.stdout)["result"]
    return answer


def wait_for_daemon(daemon: "subprocess.Popen[str]") -> None:
    """Until the link to the device runs."""
    until_s = time.monotonic() + 60.0
    while time.monotonic() < until_s:
        if daemon.poll() is not None:
            raise SystemExit((RUN_DIR / "tormagd.log").read_text())
        done = subprocess.run(
            [sys.executable, *CTL, "--json", "status"], capture_output=True, text=True, timeout=30, check=False
        )
        if done.returncode == 0 and json.loads(done.stdout)["result"]["link"]["state"] == "RUNNING":
            return
        time.sleep(0.1)
    raise SystemExit("the daemon did not reach its device within 60 s")


def watch(publisher: "subprocess.Popen[str]", duration_s: float) -> dict[str, float]:
    """The live view; returns the share of telemetry messages in which each limit was held."""
    context = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.subscribe(b"")
    socket.connect("ipc://run/demo/telemetry")
    is_terminal = sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
    held: dict[str, int] = {}
    seen = 0
    start_s = shown_s = time.monotonic()
    until_s = start_s + duration_s + 30.0
    while publisher.poll() is None and time.monotonic() < until_s:
        if not socket.poll(200):
            continue
        try:
            telemetry = decode(socket.recv(), Telemetry)
        except MessageError as error:
            print(f"telemetry: {error}", file=sys.stderr)
            continue
        seen += 1
        for limit in telemetry.limits:
            held[limit] = held.get(limit, 0) + 1
        now_s = time.monotonic()
        if now_s - shown_s >= (0.1 if is_terminal else 1.0):
            shown_s = now_s
            line = live_line(telemetry, now_s - start_s, duration_s)
            print(f"\r\x1b[K{line}" if is_terminal else line, end="" if is_terminal else "\n", flush=True)
    if is_terminal:
        print()
    socket.close(0)
    context.term()
    return {limit: count / max(seen, 1) for limit, count in held.items()}


def live_line(telemetry: Telemetry, elapsed_s: float, duration_s: float) -> str:
    """One line: a bar of the measured force with a mark where it was asked, gap, limits."""
    width, most = 32, 2.0
    measured, asked = telemetry.measured_cf or 0.0, telemetry.setpoint_cf or 0.0
    shown = "nothing" if telemetry.setpoint_cf is None else f"{asked:5.2f} N"
    filled = round(min(max(measured / most, 0.0), 1.0) * width)
    bar = list("#" * filled + "-" * (width - filled))
    bar[min(round(asked / most * width), width - 1)] = "|"
    return (
        f"{min(elapsed_s, duration_s):5.1f}/{duration_s:.0f} s [{''.join(bar)}] asked {shown} "
        f"measured {measured:5.2f} N gap {telemetry.gap_mm or 0.0:5.1f} mm "
        f"{telemetry.operating_state} {','.join(telemetry.limits)}"
    )


def rehearse_all(config: Config, times_s: Array, forces_N: Array) -> list[Rehearsal]:
    """Every case, on two processors."""
    done = []
    with concurrent.futures.ProcessPoolExecutor(max_workers=2) as pool:
        waiting = [pool.submit(rehearse, config, case, times_s, forces_N) for case in CASES]
        for number, future in enumerate(waiting, start=1):
            done.append(future.result())
            print(f"  {number}/{len(CASES)} {done[-1].case.label}", flush=True)
    return done


def scored(time_s: Array, asked_N: Array, rendered_N: Array) -> Tracking:
    """Tracking over the pulse, without the approach."""
    pulse = time_s >= RAMP_S + HOLD_S
    return tracking(asked_N[pulse], rendered_N[pulse])


def conclude(scene: Scene, shown: Shown, rehearsals: list[Rehearsal], seconds: float) -> int:
    """Prints the summary, writes it and the picture, and says whether the scene's statements were met."""
    result = scored(shown.time_s, shown.asked_N, shown.rendered_N)
    control, inference = shown.status["rates"]["control"], shown.status["rates"]["inference"]
    link = shown.status["link"]
    lost = link["lost"] + link["corrupt"] + link["repeated"]
    checks = {
        f"RMS error <= {scene.force.tolerance_rms_N:g} N": result.rms_N <= scene.force.tolerance_rms_N,
        f"variance accounted for >= {scene.force.least_variance_accounted_for:g}": result.variance_accounted_for
        >= scene.force.least_variance_accounted_for,
        f"control rate {scene.bandwidth.control_hz} Hz": abs(control["hz"] / scene.bandwidth.control_hz - 1.0) < 0.01,
        f"inference >= {scene.bandwidth.inference_hz} Hz": inference["hz"] >= scene.bandwidth.inference_hz,
        "no frame lost": lost == 0,
        "every process ended in order": not any(shown.exit_codes.values()),
    }
    print_summary(result, shown, rehearsals, lost)
    picture = RUN_DIR / "pulse.png"
    draw(picture, scene, shown.time_s, shown.asked_N, shown.rendered_N, shown.gap_mm, rehearsals, RAMP_S + HOLD_S)
    summary = {
        "tracking": result._asdict(),
        "virtual_time": {r.case.label: scored(r.time_s, r.asked_N, r.rendered_N)._asdict() for r in rehearsals},
        "rates": shown.status["rates"],
        "link": link,
        "limits_share": shown.limits,
        "exit_codes": shown.exit_codes,
        "checks": checks,
        "seconds": round(seconds, 1),
    }
    (RUN_DIR / "summary.json").write_bytes(msgspec.json.format(msgspec.json.encode(summary), indent=2))
    print(f"\nrecording {RUN_DIR / 'pulse.mcap'}   picture {picture}   figures {RUN_DIR / 'summary.json'}")
    for text, is_met in checks.items():
        print(f"  {'met   ' if is_met else 'MISSED'} {text}")
    return 0 if all(checks.values()) else 1


def print_summary(result: Tracking, shown: Shown, rehearsals: list[Rehearsal], lost: int) -> None:
    """The figures, as a table."""
    control, inference = shown.status["rates"]["control"], shown.status["rates"]["inference"]
    print(f"\nforce asked {LEAST_N}..{MOST_N} N (sd {result.reference_sd_N * 1e3:.0f} mN), rendered by the plant:")
    rows = {"real time, plant sample 1": numbers(result)}
    for rehearsal in rehearsals:
        line = numbers(scored(rehearsal.time_s, rehearsal.asked_N, rehearsal.rendered_N))
        if rehearsal.case.hand != "steady":
            line = "  (a brake: see the picture)"
        rows[f"virtual time, {rehearsal.case.label}"] = line
    width = max(map(len, rows))
    print(f"  {'':{width}s} {'RMS':>8s} {'worst':>8s}  variance accounted for")
    for label, line in rows.items():
        print(f"  {label:{width}s} {line}")
    late, spent = control["lateness_us"], control["exec_us"]
    print(
        f"control    {control['hz']:7.1f} Hz  late p50 {late['p50']:.0f} p99 {late['p99']:.0f} us, "
        f"step p50 {spent['p50']:.0f} p99 {spent['p99']:.0f} us, {control['merged']} ticks merged of {control['runs']}"
    )
    spent = inference["exec_us"]
    print(f"inference  {inference['hz']:7.1f} Hz  plan p50 {spent['p50']:.0f} p99 {spent['p99']:.0f} us")
    print(f"link       {shown.status['link']['frames']} frames, {lost} lost, repeated or corrupt")
    held = ", ".join(f"{name} {share:.1%}" for name, share in sorted(shown.limits.items())) or "none"
    print(f"limits     {held}   (share of the time shown)")


def numbers(result: Tracking) -> str:
    """RMS, worst error and variance accounted for."""
    return f"{result.rms_N * 1e3:5.1f} mN {result.worst_N * 1e3:5.0f} mN  {result.variance_accounted_for:6.3f}"


if __name__ == "__main__":
    sys.exit(main())
