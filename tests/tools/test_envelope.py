"""The envelope's own measure, and two of its runs; all of them are `make evidence`. All devices are synthetic."""

import json
import math
from pathlib import Path

import envelope
import numpy as np
import pytest
from rendering import models
from rendering.following import Followed
from rendering.models import models_table

from tormagd.lab.training.metrics import not_rising_share
from tormagd.model.model_file import load_model
from tormagd.model.shipped import model_path
from tormagd.physics.inserts import INSERTS, insert
from tormagd.simulation.parameters import load_plant

ROOT = Path(__file__).parents[2]

FLOOR_N = 0.6


def judged(asked_N: float, along_N: np.ndarray, speed_mm_s: float = 42.0) -> envelope.Figures:
    """A handle that turns steadily, a row a millisecond; the force asked is the same from the beginning."""
    time_s, same = 1e-3 * np.arange(1, len(along_N) + 1), np.ones_like(along_N)
    signed_N, speeds = along_N * math.copysign(1.0, speed_mm_s), speed_mm_s * same
    found = Followed(time_s, asked_N * same, signed_N, time_s * speed_mm_s, speeds, same, {})
    return envelope.judged(found, lambda speed_mm_s: FLOOR_N)


def forces(rows: int, excess_N: float, at: int, lasts: int) -> np.ndarray:
    found = np.full(rows, 1.0)
    found[at : at + lasts] += excess_N
    return found


@pytest.mark.parametrize(("lasts", "over_N"), [(200, 0.3), (40, 0.0)])
def test_an_excess_counts_where_it_lasts(lasts: int, over_N: float) -> None:
    assert judged(1.0, forces(6_000, 0.3, 4_000, lasts)).over_N == pytest.approx(over_N, abs=1e-9)


def test_before_a_carriage_could_have_arrived_nothing_counts() -> None:
    assert judged(1.0, forces(6_000, 0.3, 100, 400)).over_N == pytest.approx(0.0, abs=1e-9)


def test_the_greatest_force_counts_whenever_it_was() -> None:
    assert judged(1.0, forces(6_000, 1.7, 100, 5)).peak_N == pytest.approx(2.7)


def test_below_what_the_open_gap_brakes_there_is_nothing_to_fall_short_of() -> None:
    found = judged(0.2, np.full(6_000, 0.55))
    assert (found.under_N, found.settled) == (-np.inf, ())
    assert judged(1.0, np.full(6_000, 0.8)).under_N == pytest.approx(0.2)


@pytest.mark.parametrize("speed_mm_s", [42.0, -42.0])
def test_both_ways_are_sliding(speed_mm_s: float) -> None:
    found = judged(1.0, np.full(6_000, 1.1), speed_mm_s)
    assert [round(error, 6) for _, _, error in found.settled] == [0.1] * len(found.settled)
    assert found.settled


def test_a_missed_bound_is_named() -> None:
    kept = dict.fromkeys(envelope.BOUNDS, 0.0)
    assert envelope.missed(kept) == []
    assert envelope.missed(kept | {"peak_N": 5.1}) == ["peak_N = 5.100: allowed is 2.6"]


@pytest.mark.parametrize(
    "case",
    [
        envelope.Case("draw 17", "flicks", "steps"),
        envelope.Case("sample_2", "300 mm/s", "1 N", 0.0, -300.0),
    ],
    ids=str,
)
def test_a_corner_keeps_the_bounds(case) -> None:
    found = envelope.run(case)
    assert found.faults == ()
    assert found.over_N <= envelope.BOUNDS["over_N"]
    assert found.peak_N <= envelope.BOUNDS["peak_N"]


def test_the_shipped_model_is_good_where_it_is_asked() -> None:
    """By the scene's insert, on sample 1, where its handles go."""
    model = load_model(model_path("torque_mre_50_40", Path()), element="torque", insert="MRE-50-40")
    found = models.errors(model, insert("MRE-50-40"), load_plant("sample_1"), np.linspace(5.0, 300.0, 119))
    assert found["mean_N"] <= 0.03
    assert found["worst_N"] <= 0.15
    assert not_rising_share(model) == 0.0


def test_the_page_has_the_figures_of_every_model_and_none_falls_with_the_field() -> None:
    found = json.loads((ROOT / "docs/evidence/models.json").read_text(encoding="utf-8"))["figures"]
    assert {row["insert"] for row in found["rows"]} == set(INSERTS)
    assert models_table(found) in (ROOT / "docs/guides/insert.md").read_text(encoding="utf-8")
    assert all(row["not_rising_share"] == 0.0 for row in found["rows"])
    of_now = models.of_file(model_path("torque_mre_30", Path()))
    kept = {row["insert"]: row for row in found["rows"]}
    assert [row["insert"] for row in of_now] == [f"MRE-30-{iron}" for iron in (10, 20, 30, 40)]
    for row in of_now:
        for key in ("mean_N", "worst_N", "bias_N"):
            assert row[key] == pytest.approx(kept[row["insert"]][key], rel=1e-6)
