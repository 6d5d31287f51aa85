"""Table 2.5 as a method: which inserts serve a task's force range and resolution, and why the others do not."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tormagd.lab.design.brake import Brake
from tormagd.lab.design.force_law import radial_moment_for_force_Tm

_POINTS = 201


@dataclass(frozen=True, slots=True)
class ForceTask:
    """Task's demand on a brake: forces from `least_N` to `most_N`, in steps of `resolution_N`."""

    name: str
    least_N: float
    most_N: float
    resolution_N: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether one insert serves one task. `reasons` says why it does not; empty means that it does."""

    insert: str
    least_N: float
    most_N: float
    resolution_N: float
    """Largest force change that one gap step makes within the part of the task's range that the insert reaches."""
    served_share: float
    """Share of the task's force range between the insert's least and most force."""
    sufficient_gap_mm: float
    """Gap at which the force is as low as the task tolerates, its least and resolution: at least the open gap."""
    reasons: tuple[str, ...]


def judge(insert: str, brake: Brake, task: ForceTask, gap_resolution_mm: float) -> Verdict:
    """Return the verdict on one insert, a name, in its brake, for a task; the gap goes in steps of `gap_resolution_mm`."""
    least, most = brake.least_N, brake.most_N
    low, high = max(least, task.least_N), min(most, task.most_N)
    reasons = []
    if least > task.least_N + task.resolution_N:
        reasons.append(f"least force {least:.2f} N is above {task.least_N:g} N by more than {task.resolution_N:g} N")
    if most < task.most_N:
        reasons.append(f"most force {most:.2f} N is below {task.most_N:g} N")
    if low >= high:
        # no gap gives any force of the task; the finest step the insert has is the fairest figure left
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
    """Judge all inserts, brakes by name, and return the verdicts, best first; empty without any."""
    verdicts = [judge(name, brake, task, gap_resolution_mm) for name, brake in inserts.items()]
    return sorted(verdicts, key=lambda v: (bool(v.reasons), -v.served_share if v.reasons else 0.0, v.resolution_N))


def _sufficient_gap_mm(brake: Brake, task: ForceTask) -> float:
    """Return the gap, mm, at which the brake's force is as low as the task tolerates, at least the open gap."""
    tolerated_N = task.least_N + task.resolution_N
    if tolerated_N >= brake.least_N:
        return brake.open_mm
    moment_Tm = radial_moment_for_force_Tm(tolerated_N, brake.elastomer, brake.geometry)
    farthest_mm = brake.field.gap_range_mm[1]
    if moment_Tm < brake.field.radial_moment_Tm(farthest_mm):
        return math.nan
    return brake.field.gap_mm(moment_Tm)
