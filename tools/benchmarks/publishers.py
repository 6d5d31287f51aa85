"""The pulse of `make run` from every publisher in `examples/`, in turns with `tormagctl send`: what the plant renders.

Each has a daemon and a simulated device of its own, in real time. Nothing is taken off the error, no mean and no delay:
the time axis begins where the publisher says that its first setpoint was meant for. That of `examples/python` does not
say it: it sends as `tormagctl send` does, from Python.
"""

import argparse
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from machines.own import own_machine
from machines.wire import carried
from rendering.human_pulse import Array, pulse_profile, with_approach
from rendering.show import (
    ADDRESS,
    ANSWER_S,
    CONFIG,
    CTL,
    DEVICE_FIFO,
    RUN_DIR,
    end,
    process,
    wait_for_link,
    write_profile,
)
from rendering.tracking import tracking

from tormagd_client import Client

EXAMPLES = Path(__file__).parents[2] / "examples"
FOLDER = ADDRESS.removeprefix("ipc://").removesuffix("/{}")
PROFILE = RUN_DIR / "pulse.csv"
FIRST_NS = re.compile(r'(?:meant for |"start_ns":\s*)([0-9]+)')
LEAST_N, MOST_N, START_N, RAMP_S, HOLD_S = 1.4, 1.7, 0.6, 1.0, 3.0
RATE_HZ = 500


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`--seconds` of the pulse, `--rounds` of all publishers."""
    parser.add_argument("--seconds", type=float, default=20.0, help="of the pulse (%(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="each publisher plays so many times (%(default)s)")


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """RMS error in newtons, one for each round."""
    profile = with_approach(*pulse_profile(options.seconds, LEAST_N, MOST_N, RATE_HZ), START_N, RAMP_S, HOLD_S)
    with tempfile.TemporaryDirectory() as build:
        publishers = commands(Path(build))
        rms_N: dict[str, list[float]] = {name: [] for name in publishers}
        for _ in range(options.rounds):
            for name, command in publishers.items():
                rms_N[name].append(round(rendered_rms_N(command, *profile), 5))
    return {"seconds": options.seconds, "rms_N": rms_N}


def print_table(result: dict[str, Any]) -> None:
    """One line a publisher."""
    for name, rms_N in result["rms_N"].items():
        print(f"{name:16s} RMS {', '.join(f'{value * 1e3:.1f}' for value in rms_N)} mN")


def commands(build: Path) -> dict[str, list[str]]:
    """The command line of each publisher that can be run here."""
    found = {"tormagctl send": [sys.executable, *CTL, "send", str(PROFILE), "--rate", str(RATE_HZ)]}
    if shutil.which("g++"):
        compiler = ["g++", "-std=c++17", "-O2", str(EXAMPLES / "cpp" / "publish.cpp"), "-lzmq", "-o"]
        subprocess.run([*compiler, str(build / "publish")], check=True)
        found["C++"] = [str(build / "publish"), FOLDER, str(PROFILE)]
    if shutil.which("node"):
        found["JavaScript"] = ["node", str(EXAMPLES / "node" / "publish.js"), FOLDER, str(PROFILE)]
    return found


def rendered_rms_N(command: list[str], times_s: Array, forces_N: Array) -> float:
    """The error of one run, from the first setpoint to the last."""
    shutil.rmtree(RUN_DIR, ignore_errors=True)
    RUN_DIR.mkdir(parents=True)
    write_profile(PROFILE, times_s, forces_N)
    truth_path = RUN_DIR / "truth.csv"
    options = ("--pty", "--seed", "1", "--truth", str(truth_path))
    device = own_machine(DEVICE_FIFO, "tormagd.simulation", *options)
    with carried(DEVICE_FIFO), process("simulator", *device, is_read=True) as simulator:
        assert simulator.stdout is not None
        config = RUN_DIR / "tormagd.toml"
        config.write_text(CONFIG.format(port=simulator.stdout.readline().strip()))
        started = process("tormagd", "-m", "tormagd.daemon.main", "--config", str(config))
        with started as daemon, Client.local(FOLDER, ANSWER_S) as client:
            wait_for_link(daemon, client)
            if command[0] == sys.executable:  # the others home and enable by themselves
                client.arm()
            played = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
            faults = client.status().faults
        end(simulator, signal.SIGTERM)
    if played.returncode or faults:
        why = ", ".join(faults) or f"exit code {played.returncode}, what it said is above"
        sys.exit(f"{Path(command[0]).name} did not get to its end: {why}; the logs are in {RUN_DIR}")
    first = FIRST_NS.search(played.stdout)
    assert first is not None, f"{command[0]} does not say when it began: {played.stdout!r}"
    truth = np.genfromtxt(truth_path, delimiter=",", names=True)
    axis_s = (truth["t_ns"] - int(first[1])) * 1e-9
    inside = (axis_s >= times_s[0]) & (axis_s <= times_s[-1])
    return tracking(np.interp(axis_s[inside], times_s, forces_N), truth["force_N"][inside]).rms_N
