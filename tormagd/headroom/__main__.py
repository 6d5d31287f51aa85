"""`python -m tormagd.headroom [--config FILE]`: what this machine holds, as one JSON object.

`tormagctl doctor --measure` judges it. It is a process of its own, because what it measures must not share an
interpreter with the one who asks.
"""

import argparse
import asyncio
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import uvloop

from firmware_protocol.build import settle
from tormagd.config import Config, load_config
from tormagd.control.assembly.build import build_core
from tormagd.ground.machine_loop import machine_us
from tormagd.ground.terminal import write_line
from tormagd.headroom.bare_timer import Lateness, lateness
from tormagd.headroom.core_cost import Call, calls, core_cost
from tormagd_client.endpoints import ConfigError
from tormagd_client.printable import printable

TIMER_S = 2.0
CORE_S = 0.7
"In virtual time; repeating the calls takes as long again in real time."
SHARES = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tormagd.headroom", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--config", type=Path, metavar="FILE", help="the daemon's configuration")
    options = parser.parse_args(arguments)
    try:
        result = measured(load_config(options.config), TIMER_S, CORE_S)
    except ConfigError as error:
        write_line(printable(str(error)), sys.stderr)
        return 2
    return 0 if write_line(json.dumps(result), sys.stdout) is None else 1


def measured(config: Config, timer_s: float, core_s: float) -> dict[str, Any]:
    machine = machine_us()
    steps, plans = calls(config, build_core(config), core_s)  # before the timer takes the daemon's priority
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        late, (step_us, plan_us) = runner.run(_in_real_time(config, timer_s, steps, plans))
    return {
        "machine_us": round(machine, 1),
        "build": build(),
        "step_us": quantiles(step_us),
        "plan_us": quantiles(plan_us),
        "bare": {
            "rate_hz": config.rates.control_hz,
            "lateness_us": quantiles(late.beats_us),
            "missed_share": round(late.missed / (len(late.beats_us) + late.missed), 5),
            "not_granted": late.not_granted,
        },
    }


async def _in_real_time(
    config: Config, timer_s: float, steps: list[Call], plans: list[Call]
) -> tuple[Lateness, tuple[list[float], list[float]]]:
    rate_hz = config.rates.control_hz
    return await lateness(config.realtime, rate_hz, timer_s), await core_cost(steps, plans, rate_hz)


def quantiles(values: list[float]) -> dict[str, float]:
    return {"mean": round(float(np.mean(values)), 1)} | {
        name: round(float(np.percentile(values, share)), 1) for name, share in SHARES.items()
    }


def build() -> str:
    return "compiled" if settle().is_compiled else "interpreted"


if __name__ == "__main__":
    sys.exit(main())
