"""`benchmark fast`: how far the control rate can be raised, on serial lines that are fast enough for it.

The daemon with setpoints and recording, at 2 kHz on a line of 3 Mbaud and at 4 kHz on one of 4 Mbaud, the most that
`rates.control_hz` may be. The simulated device is a process of its own behind a pty, paces its bytes as that line
would, and answers each Drive with one State. A tick is *fresh* whose measurement came since the tick before it.

The device stands for a machine of its own, and has a priority just below the daemon's; where it does not keep up on
shared processors, that shows as ticks that are not fresh.
"""

import argparse
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.loop import (
    NOTHING,
    WARM_UP_S,
    Array,
    Stand,
    Ticks,
    add_realtime_arguments,
    as_block,
    asked_for,
    collect,
    collect_and_weigh,
    daemon,
    planned,
    quantiles,
    realtime_settings,
    recording,
    without_writes,
    writes,
)
from tormagd_client import ClientError

LINES = ((2_000, 3_000_000), (4_000, 4_000_000))
"Control rate, Hz, and baud."
INFERENCE_HZ = 1_000
BELOW = 5
"The device's priority is this far below the daemon's."


def course(stand: Stand, seconds: float) -> dict[str, Any]:
    """One rate on one line; `not_measured` says why where the daemon cannot run there."""
    line = {"rate_hz": stand.control_hz, "baud": stand.baud}
    try:
        with tempfile.TemporaryDirectory(prefix="tormag-") as folder:
            with daemon(stand, Path(folder)) as running, recording(running.config.endpoints) as recorder:
                collect(recorder, WARM_UP_S)
                ticks, share = collect_and_weigh(recorder, running.pid, seconds)
                plan_us = planned(running.config.endpoints.control)
            assert running.writes is not None
            written = writes(running.writes)
    except subprocess.CalledProcessError as error:
        return line | {"not_measured": (error.stderr or b"").decode(errors="replace").strip() or str(error)}
    except (RuntimeError, ClientError) as error:
        return line | {"not_measured": str(error)}
    without_us = NOTHING if written is None else without_writes(ticks, *written)
    return line | summary(ticks, stand.control_hz, without_us) | {"plan_us": plan_us, "core_share": round(share, 4)}


def summary(ticks: Ticks, rate_hz: int, without_us: Array) -> dict[str, Any]:
    """Of the ticks that there were, and of the periods that there should have been."""
    block = as_block(ticks, rate_hz)
    fresh = int(np.count_nonzero(np.diff(ticks.received_s) > 0.0))
    return {
        "ticks": block.ticks,
        "merged_share": round(block.merged / (block.ticks + block.merged), 5),
        "fresh_share": round(fresh / (block.ticks - 1), 5),
        "fresh_share_of_periods": round(fresh / (block.ticks + block.merged - 1), 5),
        "lateness_us": quantiles(block.lateness_us),
        "control_exec_us": {"mean": round(float(block.exec_us.mean()), 1)} | quantiles(block.exec_us),
        "tick_without_write_us": {"mean": round(float(without_us.mean()), 1)} | quantiles(without_us)
        if without_us.size
        else None,
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `benchmark fast`."""
    add_realtime_arguments(parser)
    parser.add_argument("--seconds", type=float, default=10.0, help="at each rate")


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """`lines`: each rate with its figures."""
    realtime = realtime_settings(options)
    stands = [
        Stand(realtime, rate_hz, INFERENCE_HZ, baud, device_fifo=max(realtime.fifo_priority - BELOW, 0))
        for rate_hz, baud in LINES
    ]
    return {"lines": [course(stand, options.seconds) for stand in stands]} | asked_for(realtime)


def print_table(result: dict[str, Any]) -> None:
    """The object for a person."""
    print(f"{'rate':>8s}{'baud':>9s}{'fresh':>8s}{'merged':>8s}{'p50':>7s}{'p99':>7s}{'p99.9':>7s}   lateness, us")
    for line in result["lines"]:
        print(f"{line['rate_hz']:5d} Hz{line['baud']:9d}", end="")
        if "not_measured" in line:
            print(f"  not measured: {line['not_measured']}")
            continue
        late, tick = line["lateness_us"], line["control_exec_us"]
        print(
            f"{line['fresh_share']:8.2%}{line['merged_share']:8.2%}"
            + "".join(f"{late[name]:7.0f}" for name in ("p50", "p99", "p999"))
            + f"   a tick {tick['mean']:.0f} us mean, {line['core_share']:.1%} of a core"
        )
    print("fresh: of the ticks that there were; a merged tick stands for a period that had none")
