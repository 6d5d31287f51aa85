"""The table of stages, `judge.py numerics` on a sample, and that each can fail."""

import math
from collections.abc import Callable

import pytest
from judge import numerics
from judge.frame import parsed
from judge.stage_table import stages
from judge.stages import HOSTILE_STEPS, Draw, Stage, tried
from leaves import leaves

from tormag_lab.arrays import Json
from tormagd.config import Position
from tormagd.control.move.pid import Pid
from tormagd.control.safety.codes import Limit
from tormagd.element.physics.brake_curve import BrakeCurve
from tormagd.element.physics.errors import DomainError

EPISODES = 12


@pytest.fixture(scope="module")
def rows() -> list[Json]:
    return [tried(stage, EPISODES, seed=1) for stage in stages()]


def test_nothing_travels_through_any_stage(rows: list[Json]) -> None:
    assert [row for row in rows if row["nonfinite"] or row["swallowed"] or row["unnamed"]] == []
    assert {row["cases"] for row in rows} == {EPISODES * HOSTILE_STEPS}


def test_a_stage_before_which_no_check_stands_refuses_by_name(rows: list[Json]) -> None:
    assert [row["stage"] for row in rows if not row["border"] and row["refused"] == 0] == []


def test_the_same_seed_gives_the_same_row(rows: list[Json]) -> None:
    place = next(place for place, row in enumerate(rows) if row["stage"] == "ask/governor")
    assert tried(stages()[place], EPISODES, seed=1) == rows[place]
    assert tried(stages()[place], EPISODES, seed=2) != rows[place]


def keeps(stage: Pid, draw: Draw) -> float:
    stage.integral = draw(0.0)
    return 0.0


def refuses(_: object, draw: Draw) -> list[Limit]:
    if not math.isfinite(value := draw(1.0)):
        raise DomainError("value", value, "a finite number")
    return [Limit.RANGE] if value != 1.0 else []


@pytest.mark.parametrize(
    ("feed", "found", "told"),
    [
        (lambda _, draw: draw(1.0), "nonfinite", "out = "),
        (keeps, "nonfinite", ".Pid.integral = "),
        (lambda _, draw: min(max(0.0, draw(1.0)), 1.0), "swallowed", "of NaN came 0.0"),
        (lambda _, draw: math.log(draw(1.0)), "unnamed", "ValueError: "),
    ],
)
def test_what_travels_is_counted_and_told(feed: Callable[..., object], found: str, told: str) -> None:
    row = tried(Stage("planted", lambda: Pid(Position()), feed), 10 * EPISODES, seed=1)
    assert row[found] > 0
    assert row["told"][0].startswith(told)


@pytest.mark.parametrize(("border", "is_refused"), [("", True), ("another", False)])
def test_refusals_and_what_is_stated_are_counted_and_behind_a_border_comes_only_what_passes_it(
    border: str, is_refused: bool
) -> None:
    row = tried(Stage("planted", lambda: None, refuses, border), EPISODES, seed=1)
    assert (row["refused"] > 0, row["stated"] > 0, row["told"]) == (is_refused, True, [])
    assert row["nonfinite"] == row["swallowed"] == row["unnamed"] == 0


def test_every_float_of_plain_data_values_and_stages_is_seen() -> None:
    stage = Pid(Position())
    stage.integral = 0.25
    assert dict(leaves([stage, (1.0, {"a": 2.0})])) == {
        ".0.Pid.integral": 0.25, ".1.0": 1.0, ".1.1.a": 2.0,
    }  # fmt: skip


def test_a_sampled_run_passes_and_has_the_agreed_keys() -> None:
    words = "numerics --cases 4000 --reference 80 --episodes 1 --workers 1"
    _, options = parsed("judge", {"numerics": ""}, words.split())
    found = numerics.measure(options)
    assert found["passed"]
    assert (found["travelled"], found["stage_cases"]) == (0, sum(row["cases"] for row in found["stages"]))
    assert found["cases"] >= 4_000
    assert found["reference_cases"] >= 80
    assert found["refused"] > 0
    assert found["nonfinite"] == found["misjudged"] == 0
    for kind, most in (("float64", 1e-12), ("float32", 1e-5), ("float32_soft", 3e-4)):
        assert 0.0 < found["worst_rel_error"][kind] <= most
    assert all(share <= 1.0 for share in found["over_allowed"].values())


FORCE = BrakeCurve.force


@pytest.mark.parametrize(
    ("name", "formula", "seen", "least"),
    [
        ("force", lambda self, eps, load: FORCE(self, eps, load) * (1.0 + 1e-11), "force", 5.0),
        (
            "compression",
            lambda self, y: ((1 - self.a * y) ** 2 + 2 * self.b * y) ** 0.5 - (1 - self.a * y),
            "stretch",
            10.0,
        ),
    ],
    ids=["an error", "a naive formula"],
)
def test_what_is_wrong_in_the_physics_is_seen(
    monkeypatch: pytest.MonkeyPatch, name: str, formula: Callable[..., float], seen: str, least: float
) -> None:
    monkeypatch.setattr(BrakeCurve, name, formula)
    tally = numerics.check_chunk(seed=3, devices=8, references=20)
    assert tally.worst["float64", seen][1] > least
    assert name == "compression" or tally.worst["float64", "stretch"][1] < 1.0
