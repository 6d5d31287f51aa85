"""Table 2.5 as a method: which inserts serve a task's forces and resolution, and why the others do not."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tormag_lab.design.brake import Brake
from tormag_lab.design.force_law import radial_moment_for_force_Tm

_POINTS = 201


@dataclass(frozen=True, slots=True)
class ForceTask:
    name: str
    least_N: float
    most_N: float
    resolution_N: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether one insert serves one task, and the `reasons` why it does not."""

    insert: str
    least_N: float
    most_N: float
    resolution_N: float
    "Largest force change of one gap step, where the insert reaches the task's forces."
    served_share: float
    "Share of the task's range that the insert reaches."
    sufficient_gap_mm: float
    "Gap, the open one or wider, that gives the task's least force plus its resolution."
    reasons: tuple[str, ...]


def judge(insert: str, brake: Brake, task: ForceTask, gap_resolution_mm: float) -> Verdict:
    """Judge an insert for a task, with a gap that moves in steps of `gap_resolution_mm`."""
    least, most = brake.least_N, brake.most_N
    low, high = max(least, task.least_N), min(most, task.most_N)
    reasons = []
    if least > task.least_N + task.resolution_N:
        reasons.append(f"least force {least:.2f} N is above {task.least_N:g} N by more than {task.resolution_N:g} N")
    if most < task.most_N:
        reasons.append(f"most force {most:.2f} N is below {task.most_N:g} N")
    if low >= high:
        # no gap gives any force of the task, so the insert's finest step is the fairest figure left
        resolution = gap_resolution_mm * brake.slope_N_mm(brake.open_mm)
        share = 0.0
    else:
        gaps = np.clip(np.linspace(brake.gap_mm(high), brake.gap_mm(low), _POINTS), brake.closed_mm, brake.open_mm)
        resolution = gap_resolution_mm * float(np.max(brake.slope_N_mm(gaps)))
        share = (high - low) / (task.most_N - task.least_N)
    if resolution > task.resolution_N:
        reasons.append(f"one gap step changes {1e3 * resolution:.1f} mN, more than {1e3 * task.resolution_N:g} mN")
    return Verdict(insert, least, most, resolution, share, _sufficient_gap_mm(brake, task), tuple(reasons))


def rank(inserts: Mapping[str, Brake], task: ForceTask, gap_resolution_mm: float) -> list[Verdict]:
    verdicts = [judge(name, brake, task, gap_resolution_mm) for name, brake in inserts.items()]
    return sorted(verdicts, key=lambda v: (bool(v.reasons), -v.served_share if v.reasons else 0.0, v.resolution_N))


def _sufficient_gap_mm(brake: Brake, task: ForceTask) -> float:
    tolerated_N = task.least_N + task.resolution_N
    if tolerated_N >= brake.least_N:
        return brake.open_mm
    moment_Tm = radial_moment_for_force_Tm(tolerated_N, brake.elastomer, brake.geometry)
    farthest_mm = brake.field.gap_range_mm[1]
    if moment_Tm < brake.field.radial_moment_Tm(farthest_mm):
        return math.nan
    return brake.field.gap_mm(moment_Tm)
