"""How a force is followed: signals, draws, figures of one short run; the envelope."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from judge import envelope, models, tracking
from judge.following import PULSE_N, RATE_HZ, Followed, publisher, tracking as scored
from judge.frame import parsed, told
from judge.signals import recorded_signals
from judge.tracking import (
    ARRIVES_S,
    LATER_S,
    STEP_S,
    step_figures,
    track,
)

from tormag_lab.arrays import Json, rms
from tormag_lab.human_pulse import pulse_profile
from tormag_lab.ideal_carriage import bound
from tormag_lab.training.dataset import not_rising_share
from tormagd.element.model.model_file import load_model, model_path
from tormagd.element.physics.inserts import INSERTS, insert
from tormagd.simulation.parameters import load_plant

BEGINS_S, IDEAL_S = 4.0, 0.9


@pytest.mark.parametrize(("named", "measured"), [([], tuple(tracking.CASES)), (["pulse", "steps"], ("steps", "pulse"))])
def test_without_a_name_every_case_is_measured(monkeypatch: pytest.MonkeyPatch, capsys, named, measured) -> None:
    monkeypatch.setattr(tracking, "of_case", lambda case: {"of": [case]})
    module, options = parsed("judge", {"tracking": ""}, ["tracking", "--json", *named])
    assert told(module, options, module.measure(options)) == 0
    assert tuple(json.loads(capsys.readouterr().out)) == measured
    assert told(module, options, {"passed": False, "missed": ["a bound"]}) == 1
    assert capsys.readouterr().err == "missed: a bound\n"


def course(*errors: tuple[float, float, float]) -> Followed:
    """Return ten seconds of 1 N with these errors: from, to, s, and how much, N."""
    time_s = 1e-3 * np.arange(10_000)
    asked_N, felt_N, still = np.ones_like(time_s), np.ones_like(time_s), np.zeros_like(time_s)
    for from_s, to_s, much_N in errors:
        felt_N[(time_s >= from_s) & (time_s < to_s)] += much_N
    return Followed(time_s, asked_N, felt_N, still, still, {})


def swing(amplitude_N: float, hz: float) -> tuple[np.ndarray, np.ndarray]:
    time_s = np.arange(800) / 500
    return time_s, 1.5 + amplitude_N * np.sin(2.0 * np.pi * hz * time_s)


@pytest.fixture(scope="module")
def swung() -> Followed:
    return track(load_plant("sample_1"), *swing(0.1, 1.5), 0.07)


def test_a_swing_is_rendered_and_nothing_holds_it_back(swung: Followed) -> None:
    found = swung.since(0.8)
    assert found.rms_N <= 0.015
    assert found.variance_accounted_for >= 0.95
    assert swung.time_s[[0, -1]] == pytest.approx([0.0, 1.6], abs=0.01)
    assert "STALE" not in swung.limits
    assert all(0.0 <= share <= 1.0 for share in swung.limits.values())


def test_no_figure_is_better_than_that_of_the_ideal_carriages(swung: Followed) -> None:
    plant, (time_s, fast_N) = load_plant("sample_1"), swing(0.2, 6.0)
    slowly = bound(plant, *swing(0.1, 1.5)).figures(0.8)
    assert max(slowly["foresight_rms_N"], slowly["no_delay_rms_N"]) <= 1e-6 <= swung.since(0.8).rms_N
    least = bound(plant, time_s, fast_N).figures()
    assert 0.01 <= least["foresight_rms_N"] < least["no_delay_rms_N"]
    rushed = track(plant, time_s, fast_N, 0.0)
    assert rushed.since(0.0).rms_N >= least["foresight_rms_N"]
    # nothing is foreseen yet, for which three swings are too few
    at_first = bound(plant, time_s[:250], fast_N[:250]).figures()
    assert rms(rushed.error_N[rushed.time_s < 0.5]) >= at_first["no_delay_rms_N"]


def test_weak_motors_render_a_live_pulse_once_it_is_foreseen() -> None:
    found = track(load_plant("sample_2"), *pulse_profile(6.5, *PULSE_N, RATE_HZ), 0.0)
    assert found.since(4.5).rms_N <= 0.02
    assert found.shown.lag_s > 0.005


def test_nothing_is_removed_from_the_error() -> None:
    reference = np.sin(np.linspace(0.0, 20.0, 1_000))
    result = scored(reference, reference + 0.5)
    assert (result.rms_N, result.variance_accounted_for) == pytest.approx((0.5, 1.0 - 0.25 / reference.var()))


def test_the_pulse_spans_what_was_asked_and_has_no_images() -> None:
    times_s, forces_N = pulse_profile(10.0, 1.4, 1.7, 500)
    assert (len(times_s), forces_N.min(), forces_N.max()) == pytest.approx((5_000, 1.4, 1.7))
    spectrum = np.abs(np.fft.rfft((forces_N - forces_N.mean()) * np.hanning(len(forces_N))))
    assert spectrum[np.fft.rfftfreq(len(forces_N), 2e-3) > 30.0].max() < 1e-3 * spectrum.max()
    with pytest.raises(ValueError, match="allowed is up to"):
        pulse_profile(60.0, 1.4, 1.7, 500)


def test_a_step_is_judged_once_it_arrived_a_second_later_and_by_its_greatest() -> None:
    arrives_s = BEGINS_S + IDEAL_S + ARRIVES_S
    found = course(
        (BEGINS_S, BEGINS_S + IDEAL_S, -1.3),  # on its way
        (arrives_s, arrives_s + 0.1, -0.05),
        (arrives_s + LATER_S, arrives_s + LATER_S + 0.1, 0.02),
        (arrives_s + 0.5, arrives_s + 0.6, 0.09),
        (BEGINS_S + STEP_S, 10.0, 1.3),  # the next step
    )
    assert step_figures(found, BEGINS_S, IDEAL_S, 1.0) == pytest.approx(
        {"arrived_N": -0.05, "later_N": 0.02, "overshoot_N": 0.09}
    )
    # downwards a force below the one asked is beyond it
    assert step_figures(found, BEGINS_S, IDEAL_S, -1.0)["overshoot_N"] == pytest.approx(0.05)


def test_the_worst_is_of_means_in_between() -> None:
    found = course((3.0, 3.2, -0.4), (5.0, 5.001, 5.0), (8.0, 9.0, 1.0))
    assert (found.worst_N(2.0, 4.0), found.worst_N(4.5, 6.0)) == pytest.approx((0.4, 0.1))


def test_a_publisher_sends_what_follows() -> None:
    times, forces = np.arange(100) / 500, np.linspace(1.0, 2.0, 100)
    publish = publisher(times + 3.0, forces, 0.02)
    assert publish(2.999) is None
    setpoint = publish(3.0101)
    assert (setpoint.force_N, setpoint.preview_dt_s, setpoint.preview_N) == (
        pytest.approx(forces[5]),
        0.002,
        pytest.approx(forces[6:16]),
    )
    assert publisher(times, forces, 0.0)(0.1).preview_N == ()


def test_recorded_signals_are_in_the_devices_range(recordings, monkeypatch) -> None:
    monkeypatch.setenv("TORMAG_DATA", str(recordings))
    found = recorded_signals()
    assert {signal.split()[0] for signal in found} == {"finger", "arterial", "haptic"}
    for signal, (time_s, force_N) in found.items():
        assert np.all(np.diff(time_s) > 0.0)
        assert 0.55 <= force_N.min() <= force_N.max() <= (2.0 if signal.startswith("haptic") else 1.75)


ROOT = Path(__file__).parents[2]

FLOOR_N = 0.6


def judged(asked_N: float, along_N: np.ndarray, speed_mm_s: float = 42.0) -> Json:
    time_s, same = 1e-3 * np.arange(1, len(along_N) + 1), np.ones_like(along_N)
    signed_N, speeds = along_N * math.copysign(1.0, speed_mm_s), speed_mm_s * same
    found = Followed(time_s, asked_N * same, signed_N, time_s * speed_mm_s, speeds, {})
    return envelope.judged(found, lambda speed_mm_s: FLOOR_N)


def forces(excess_N: float, at: int, lasts: int) -> np.ndarray:
    return 1.0 + excess_N * np.isin(np.arange(6_000), np.arange(at, at + lasts))


@pytest.mark.parametrize(
    ("asked_N", "along_N", "figure", "expected_N"),
    [
        (1.0, forces(0.3, 4_000, 200), "over_N", 0.3),
        (1.0, forces(0.3, 4_000, 40), "over_N", 0.0),
        (1.0, forces(0.3, 100, 400), "over_N", 0.0),
        (1.0, forces(1.7, 100, 5), "peak_N", 2.7),
        (1.0, np.full(6_000, 0.8), "under_N", 0.2),
        (0.2, np.full(6_000, 0.55), "under_N", -np.inf),
    ],
    ids=[
        "an excess",
        "one that does not last",
        "before a carriage could have arrived",
        "the greatest whenever it was",
        "a lack",
        "below what the open gap brakes",
    ],
)
def test_what_counts_of_a_run(asked_N: float, along_N: np.ndarray, figure: str, expected_N: float) -> None:
    assert judged(asked_N, along_N)[figure] == pytest.approx(expected_N, abs=1e-9)


@pytest.mark.parametrize("speed_mm_s", [42.0, -42.0])
def test_both_ways_are_sliding(speed_mm_s: float) -> None:
    assert {round(error, 6) for _, _, error in judged(1.0, np.full(6_000, 1.1), speed_mm_s)["settled"]} == {0.1}
    assert judged(0.2, np.full(6_000, 0.55), speed_mm_s)["settled"] == ()


def test_a_missed_bound_is_named() -> None:
    kept = dict.fromkeys(envelope.BOUNDS, 0.0)
    assert envelope.missed(kept) == []
    assert envelope.missed(kept | {"peak_N": 5.1}) == ["peak_N = 5.100: allowed is 2.6"]


@pytest.mark.parametrize(
    "case",
    [
        envelope.Case("draw 17", "flicks", "steps"),
        envelope.Case("sample_2", "300 mm/s", "1 N", 0.0, -300.0),
        envelope.Case("draw 46", "other reversals", "steps"),
        envelope.Case("sample_2", "ladder", "ladder at 0.8 N"),
    ],
    ids=str,
)
def test_a_corner_keeps_the_bounds(case) -> None:
    found = envelope.run(case)
    assert found["faults"] == ()
    assert all(found[name] <= envelope.BOUNDS[name] for name in ("over_N", "peak_N"))
    assert all(abs(error_N) <= envelope.BOUNDS["settled_N"] for _, _, error_N in found["settled"])


def test_the_shipped_model_is_good_where_it_is_asked() -> None:
    model = load_model(model_path("torque_mre_50_40", Path()), element="torque", insert="MRE-50-40")
    found = models.errors(model, insert("MRE-50-40"), load_plant("sample_1"), np.linspace(5.0, 300.0, 119))
    assert found["mean_N"] <= 0.03
    assert found["worst_N"] <= 0.15
    assert not_rising_share(model) == 0.0


def test_the_page_has_the_figures_of_every_model_and_none_falls_with_the_field() -> None:
    found = json.loads((ROOT / "docs/evidence/models.json").read_text(encoding="utf-8"))["figures"]
    assert {row["insert"] for row in found["rows"]} == set(INSERTS)
    assert "\n".join(models.shown(found)) in (ROOT / "docs/guides/insert.md").read_text(encoding="utf-8")
    assert all(row["not_rising_share"] == 0.0 for row in found["rows"])
    of_now = models.of_file(model_path("torque_mre_30", Path()))
    kept = {row["insert"]: row for row in found["rows"]}
    assert [row["insert"] for row in of_now] == [f"MRE-30-{iron}" for iron in (10, 20, 30, 40)]
    for row in of_now:
        figures = {key: row[key] for key in ("mean_N", "worst_N", "bias_N")}
        assert figures == pytest.approx({key: kept[row["insert"]][key] for key in figures}, rel=1e-6)
