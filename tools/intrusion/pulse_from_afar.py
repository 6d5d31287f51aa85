"""The demo's pulse from a listed publisher on another machine (a network namespace), beside the same from this one.

Both drive a daemon and a device of their own, in turns, so that what else runs here falls on both: here over `ipc://`,
as in the demo, there over TCP with keys and a cable between. Rendered is the plant's force.
"""

import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from benchmarks.loop import daemon
from machines.two import HERE, Machines, NotPermittedError, two_machines
from rendering.human_pulse import Array
from rendering.show import PULSE_S, RATE_HZ, profile, scored, write_profile
from tqdm import tqdm

from intrusion.besieged import Line, elsewhere, stand

PAIRS = 3
WITHIN_N = 1e-3
PATIENCE_S = 60.0
ANYWHERE = Machines((), ())


def measure(share: float) -> Line:
    """Pairs of plays. `share` of the pairs, and of the pulse where that is less than one."""
    pairs = max(1, round(PAIRS * share))
    times_s, forces_N = profile(min(PULSE_S, PULSE_S * PAIRS * share))
    rms_N: dict[str, list[float]] = {"local": [], "far": []}
    try:
        with two_machines() as machines:
            for _ in tqdm(range(pairs), desc="pulse from afar", unit="pair", disable=None):
                rms_N["local"].append(played(ANYWHERE, times_s, forces_N))
                rms_N["far"].append(played(machines, times_s, forces_N))
    except NotPermittedError as error:
        return Line(f"not measured: {error}", [f"not measured: {error}"], {})
    return judged(rms_N["local"], rms_N["far"])


def played(machines: Machines, times_s: Array, forces_N: Array) -> float:
    """RMS error of one play, N, of which the publisher is on the other machine where there is one."""
    with tempfile.TemporaryDirectory(prefix="tormag-") as name:
        folder = Path(name)
        write_profile(folder / "pulse.csv", times_s, forces_N)
        stood = stand(
            scene="pulse",
            setpoint_hz=0,
            device=("--seed", "1", "--truth", str(folder / "truth.csv")),
            guarded=("setpoint",) if machines.here else (),
            host=HERE,
            within=machines.here,
        )
        send = ["-m", "tormagd.ctl.main", "--config", str(folder / "tormagd.toml"), "--json", "send"]
        with daemon(stood, folder), elsewhere():
            done = subprocess.run(
                [*machines.there, sys.executable, *send, str(folder / "pulse.csv"), "--rate", str(RATE_HZ)],
                check=True,
                stdout=subprocess.PIPE,
                timeout=PATIENCE_S + float(times_s[-1]),
            )
        truth = np.genfromtxt(folder / "truth.csv", delimiter=",", names=True)
    axis = (truth["t_ns"] - json.loads(done.stdout)["result"]["start_ns"]) * 1e-9
    inside = (axis >= times_s[0]) & (axis <= times_s[-1])
    return scored(axis[inside], np.interp(axis[inside], times_s, forces_N), truth["force_N"][inside]).rms_N


def judged(local_N: list[float], far_N: list[float]) -> Line:
    """The line's figures and what did not hold: RMS errors of the pairs, N."""
    apart_N = statistics.median(far - local for local, far in zip(local_N, far_N, strict=True))
    failures = []
    if abs(apart_N) > WITHIN_N:
        failures.append(f"the pulse from afar differs by {apart_N * 1e3:+.2f} mN RMS, allowed {WITHIN_N * 1e3:g}")
    local_mN, far_mN = ([round(rms * 1e3, 2) for rms in each] for each in (local_N, far_N))
    says = (
        f"the demo's pulse from a listed publisher in another namespace: RMS {statistics.median(far_mN):.1f} mN, from "
        f"here {statistics.median(local_mN):.1f}, {apart_N * 1e3:+.2f} in the median of {len(far_N)} pairs (allowed "
        f"{WITHIN_N * 1e3:g})"
    )
    return Line(says, failures, {"local_mN": local_mN, "far_mN": far_mN, "apart_mN": round(apart_N * 1e3, 3)})
