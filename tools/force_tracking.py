"""How well a force is followed: the true force of simulated devices less what was asked, in virtual time.

    force_tracking.py [CASE ...] [--draws N] [--json]

How soon a device is known: `steps`, `creep` and `speeds`, of samples, second plant (its structure is another) and draws
of the plant card. Without draws it shows where an hour of `drift` of the force sensor leads. How well signals are
followed: the `pulse` of `make run` on all of these, and in full on the `samples` and the second plant. There are 500
setpoints a second, with a preview of 70 ms and live. Recorded `signals` from the folder that TORMAG_DATA names, with
400 ms, as a publisher can that plays a file, and live. Beside them stands what ideal carriages miss (`bound.py`), and
beside `samples` what the same core does with carriages that lose no time. Draws 40 to 79, samples 2 and 3 and the
second plant only judge. All devices are synthetic.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import Any

import numpy as np
from rendering import cases
from rendering.device_draws import judging
from tqdm import tqdm

from tormagd.lab.arrays import Json
from tormagd.lab.told import lines

DRAWS = 40
OF_DEVICES = {
    "steps": cases.steps,
    "creep": cases.creep,
    "speeds": cases.speeds,
    "drift": cases.drift,
    "pulse": cases.pulse,
}
OF_SIGNALS: dict[str, Callable[[Executor], Any]] = {
    "samples": cases.samples,
    "signals": cases.signals,
}
CASES = (*OF_DEVICES, *OF_SIGNALS)


def measure(case: str, options: argparse.Namespace, pool: Executor) -> Any:
    """One case."""
    if case in OF_SIGNALS:
        return OF_SIGNALS[case](pool)
    names = judging(0 if case == "drift" else options.draws)
    found = tqdm(pool.map(OF_DEVICES[case], names), desc=case, total=len(names), disable=not sys.stderr.isatty())
    return dict(zip(names, found, strict=True))


def worst(devices: dict[str, Json]) -> list[Json]:
    """A row for each figure that devices have in common: the greatest without its sign, whose it is, and the median."""
    sizes = {device: dict(_sizes(found)) for device, found in devices.items()}
    rows = []
    for figure in next(iter(sizes.values())):
        of_devices = {device: found[figure] for device, found in sizes.items() if figure in found}
        device = max(of_devices, key=lambda device: of_devices[device])
        median = float(np.median(list(of_devices.values())))
        rows.append({"figure": figure, "worst": of_devices[device], "device": device, "median": median})
    return rows


def _sizes(found: object, name: str = "") -> Iterator[tuple[str, float]]:
    """Every number in plain data, without its sign."""
    if isinstance(found, dict | list | tuple):
        for key, value in found.items() if isinstance(found, dict) else enumerate(found, 1):
            yield from _sizes(value, f"{name}, {key}".removeprefix(", "))
    elif isinstance(found, int | float):
        yield name, abs(found)


def main() -> int:
    """Measures and prints; 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("cases", nargs="*", choices=CASES, help="default: all")
    parser.add_argument("--draws", type=int, default=DRAWS, help=f"devices of the plant card ({DRAWS})")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at a time")
    options = parser.parse_args()
    result: Json = {}
    with ProcessPoolExecutor(max_workers=options.jobs) as pool:
        for case in options.cases or CASES:
            result[case] = measure(case, options, pool)
    told = {case: found if case in OF_SIGNALS else worst(found) for case, found in result.items()}
    print(json.dumps(result) if options.json else "\n".join(lines(told)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
