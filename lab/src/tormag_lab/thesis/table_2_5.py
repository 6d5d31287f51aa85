"""Table 2.5, which insert serves which task: as the thesis meant it, and strictly.

The thesis matches the width of an insert's force *range* to the task's, wherever it begins. Strictly, a task is served
from its own least force on, and a passive brake does not reach 0 N.
"""

from collections.abc import Mapping

import numpy as np

from tormag_lab.arrays import Json
from tormag_lab.design.brake import CLOSED_MM, Brake
from tormag_lab.thesis.values import TABLE_2_5, ForceTask
from tormagd.element.physics.inserts import INSERTS

GAP_RESOLUTION_MM = 0.1
"Reach of a plain position loop against the screws' backlash; the thesis's table implies a little less."
_POINTS = 201
COLUMNS = (
    "task",
    "insert the thesis names",
    "range measured, N",
    "range matched",
    "missed",
    "resolution reached (thesis), mN",
    "narrowest that matches",
    "strictly",
)


def table_2_5() -> Json:
    """Judge every insert for every task, the best first by the strict reading."""
    # the law must hold beyond the device's open gap
    brakes = {item.name: Brake.as_built(item.elastomer) for item in INSERTS.values()}
    steps = [
        1e-3 * resolution_mN / brakes[name].slope_N_mm(CLOSED_MM)
        for _, named in TABLE_2_5
        for name, resolution_mN in named.items()
    ]
    return {
        "tasks": [
            {
                "task": task.name,
                "range_N": [task.least_N, task.most_N],
                "resolution_N": task.resolution_N,
                "thesis_mN": named,
                "ranked": rank(brakes, task, GAP_RESOLUTION_MM),
            }
            for task, named in TABLE_2_5
        ],
        "gap_resolution_mm": GAP_RESOLUTION_MM,
        "implied_gap_resolution_mm": [min(steps), max(steps)],
        "note": "As the thesis meant it, an insert serves a task if its measured range (table 2.4) is as wide as the "
        "task's. Strictly the least force counts too, and a passive brake does not reach 0 N. Resolution is the force "
        "of the steepest gap step.",
    }


def rank(inserts: Mapping[str, Brake], task: ForceTask, gap_resolution_mm: float) -> list[Json]:
    rows = [judge(name, brake, task, gap_resolution_mm) for name, brake in inserts.items()]
    return sorted(
        rows, key=lambda row: (not row["serves"], -row["served_share"] * bool(row["reasons"]), row["resolution_mN"])
    )


def judge(insert: str, brake: Brake, task: ForceTask, gap_resolution_mm: float) -> Json:
    """Return what an insert reaches of a task with a gap that moves in such steps, and why it does not serve."""
    least, most, width_N = brake.least_N, brake.most_N, task.most_N - task.least_N
    low, high = max(least, task.least_N), min(most, task.most_N)
    if low >= high:
        # no gap gives any force of the task, so the insert's finest step is the fairest figure left
        gaps = np.array([brake.open_mm])
    else:
        gaps = np.clip(np.linspace(brake.gap_mm(high), brake.gap_mm(low), _POINTS), brake.closed_mm, brake.open_mm)
    resolution_N = gap_resolution_mm * float(np.max(brake.slope_N_mm(gaps)))
    lacks = {
        f"least force {least:.2f} N is above {task.least_N:g} N by more than {task.resolution_N:g} N": (
            least > task.least_N + task.resolution_N
        ),
        f"most force {most:.2f} N is below {task.most_N:g} N": most < task.most_N,
        f"one gap step changes {1e3 * resolution_N:.1f} mN, more than {1e3 * task.resolution_N:g} mN": (
            resolution_N > task.resolution_N
        ),
    }
    reasons = [reason for reason, is_so in lacks.items() if is_so]
    measured_N = INSERTS[insert].force_range.measured_N
    return {
        "insert": insert,
        "measured_range_N": measured_N,
        "matched_share": min(measured_N / width_N, 1.0),
        "serves": not reasons,
        "force_N": [least, most],
        "resolution_mN": 1e3 * resolution_N,
        "served_share": max(high - low, 0.0) / width_N,
        "reasons": reasons,
    }


def readings(table: Json) -> list[tuple[str, ...]]:
    """Return a row of text, as COLUMNS, for each insert that the thesis names."""
    return [
        (
            f"{task['task']}, {task['range_N'][0]:g}..{task['range_N'][1]:g} N",
            row["insert"],
            f"{row['measured_range_N']:.2f}",
            f"{row['matched_share']:.0%}",
            _missed(row, task),
            f"{row['resolution_mN']:.1f} ({task['thesis_mN'][row['insert']]:g})",
            _narrowest(task),
            f"{'in' if row['serves'] else 'out'}, {row['served_share']:.0%} served",
        )
        for task in table["tasks"]
        for row in task["ranked"]
        if row["insert"] in task["thesis_mN"]
    ]


def _missed(row: Json, task: Json) -> str:
    (least_N, most_N), given_N = task["range_N"], row["force_N"][0]
    missed = [f"{least_N:g}..{given_N:.2f} N"] if given_N > least_N else []
    if row["matched_share"] < 1.0:
        missed.append(f"{most_N - least_N - row['measured_range_N']:.2f} N of the width")
    return ", ".join(missed) or "nothing"


def _narrowest(task: Json) -> str:
    matching = [row for row in task["ranked"] if row["matched_share"] == 1.0]
    return min(matching, key=lambda row: row["measured_range_N"], default={"insert": "none"})["insert"]
