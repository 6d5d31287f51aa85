"""Scenes: the shipped ones give a working core, contradictions and misfits are refused."""

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from tormagd.config import Config, Rates, load_config
from tormagd.control.assembly.build import Core, build_core
from tormagd.control.records import TimedSetpoint
from tormagd.element.model.displacement import MOBILISED_MM
from tormagd.element.model.features import FEATURES
from tormagd.element.model.model_file import load_model, model_path
from tormagd.element.physics.inserts import INSERTS, insert
from tormagd.scenes.measured import (
    ENDING,
    TOLERATED,
    WORSE,
    MeasuredScene,
    OperatingPoint,
    Served,
    allowed_N,
    at_rates_of,
    measured,
    served_like,
)
from tormagd.scenes.scene import EVERY_TERM, Bandwidth, Signal, Terms, load_scene, shipped_scenes
from tormagd.scenes.signal import asked
from tormagd_client.endpoints import ConfigError

BASE = {
    "name": '"bench"',
    "description": '"A scene of the tests."',
    "force.least_N": "0.0",
    "force.most_N": "2.0",
    "force.resolution_N": "0.1",
    "force.tolerance_rms_N": "0.05",
    "insert.name": '"MRE-50-40"',
    "insert.model": '"torque_mre_50_40"',
}
Write = Callable[..., str]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes the base scene with some keys changed, dropped (None) or added."""

    def write_toml(**changes: str | None) -> str:
        keys = BASE | {key.replace("__", "."): value for key, value in changes.items()}
        path = tmp_path / "scene.toml"
        path.write_text("\n".join(f"{key} = {value}" for key, value in keys.items() if value is not None))
        return str(path)

    return write_toml


def of_path(path: str) -> Core:
    return build_core(Config(scene=path))


def refused(name_or_path: str, *said: str, load: Callable[[str], object] = load_scene) -> None:
    with pytest.raises(ConfigError) as caught:
        load(name_or_path)
    assert [words for words in said if words not in str(caught.value)] == []


def test_the_thesiss_tasks_are_shipped() -> None:
    table_2_5 = ("cardiovascular", "brain", "bronchoscopy", "vitreoretinal", "laparoscopy")
    others = ("coronary", "fluoroscopy", "pulse", "radial_hold", "radial_pulse", "aorta_1", "aorta_2")
    assert set(shipped_scenes()) == {*table_2_5, *others}
    assert all(load_scene(name).signal is not None for name in shipped_scenes())


@pytest.mark.parametrize("name", shipped_scenes())
def test_a_shipped_scene_gives_a_core_that_can_render_it(name: str) -> None:
    core = build_core(Config(scene=name))
    assert (core.scene, core.scene.name) == (load_scene(name), name)
    assert core.scene.description.endswith(".")
    # a scene may like less than the device's least force, but nothing above its greatest
    assert core.portrait.min_N < core.scene.force.most_N <= core.portrait.max_N
    assert core.margins.phase_margin_deg >= 45.0
    assert core.margins.gain_margin_dB >= 6.0


def test_a_name_of_no_file_lists_the_shipped_ones_or_says_why_it_is_none() -> None:
    refused("coronery", "scene = 'coronery'", *shipped_scenes())
    refused("x" * 300, "File name too long")


def contradicts(low: str, low_value: float, high: str, high_value: float) -> tuple[dict[str, str], tuple[str, str]]:
    keys = {low.replace(".", "__"): str(low_value), high.replace(".", "__"): str(high_value)}
    return keys, (f"{low} = {low_value:g}", f"under {high} = {high_value:g}")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"force__most_N": "-1.0"}, ("$.force.most_N", "-1.0", ">= 0.001")),
        ({"force__most_N": "5e-324"}, ("$.force.most_N", ">= 0.001")),
        ({"force__most_N": "nan"}, ("force.most_N", "nan", "finite")),
        ({"force__most_N": '"2"'}, ("$.force.most_N", "'2'", "`float`")),
        ({"force__most_N": None}, ("most_N", "missing")),
        ({"force__strength": "1.0"}, ("strength", "unknown field")),
        ({"force__tolerance_rms_N": "0.0"}, ("$.force.tolerance_rms_N", "> 0.0")),
        ({"force__resolution_N": "0.0"}, ("$.force.resolution_N", "> 0.0")),
        ({"insert__model": None}, ("model", "missing")),
        ({"solver__step_mT": "5e-324"}, ("$.solver.step_mT", "5e-324", ">= 0.001")),
        ({"solver__neighbours": "1.5"}, ("$.solver.neighbours", "1.5", "`int`")),
        ({"bandwidth__inference_hz": "50"}, ("$.bandwidth.inference_hz", "50", ">= 83")),
        ({"signal__file": '"a.csv"', "signal__hold_s": "1.0"}, ("signal.hold_s = 1.0", "none beside signal.file")),
        ({"signal__hold_s": "1.0"}, ("signal.bandwidth_hz is missing",)),
        ({"signal__bandwidth_hz": "1e-320"}, ("$.signal.bandwidth_hz", "1e-320", ">= 0.0001")),
        ({"signal__bandwidth_hz": "0.2", "signal__step_N": "1e-9"}, ("$.signal.step_N", "1e-09", ">= 0.001")),
        ({"insert__gap_speed_mm_s": "5e-324"}, ("$.insert.gap_speed_mm_s", ">= 0.1")),
        ({"signal__bandwidth_hz": "101.0"}, ("$.signal.bandwidth_hz", "<= 100.0")),
        ({"signal__bandwidth_hz": "0.2", "signal__setpoint_hz": "10.0"}, ("$.signal.setpoint_hz", ">= 12.0")),
        ({"signal__bandwidth_hz": "1.0", "signal__hold_s": "90000.0"}, ("$.signal.hold_s", "<= 86400.0")),
        ({"name": '"a\\u001b[31mb"'}, ("name = 'a\\x1b[31mb'", "control characters")),
        ({"description": '"a\\u009b31mb"'}, ("description = ", "control characters")),
        ({"force__release_N_s": "1e-9"}, ("force.release_N_s = 1e-09", "at least force.most_N / 30 s, 0.067")),
        ({"insert__roller_radius_mm": "0.001"}, ("$.insert.roller_radius_mm", ">= 0.01")),
        contradicts("force.least_N", 2.0, "force.most_N", 2.0),
        contradicts("force.least_N", 3.0, "force.most_N", 2.0),
        contradicts("force.release_N_s", 30.0, "force.most_release_N_s", 20.0),
        contradicts("insert.gap_closed_mm", 95.0, "insert.gap_open_mm", 45.0),
        contradicts("insert.gap_closed_mm", 60.0, "insert.gap_open_mm", 60.0),
        contradicts("insert.inner_radius_mm", 11.0, "insert.outer_radius_mm", 4.0),
        ({"handle__least_mm_s": "50.0"}, ("handle.least_mm_s = 50", "at most handle.most_mm_s = 42")),
        ({"handle__least_mm_s": "0.1"}, ("$.handle.least_mm_s", ">= 0.5")),
        ({"budget__core_share": "0.0"}, ("$.budget.core_share", "> 0.0")),
        ({"terms": '"some"'}, ("$.terms", "'some'")),
        ({"terms": '"required"'}, ("a `[table]`", "$.terms", "required")),
        ({"terms__gravity": "false"}, ("gravity", "unknown field")),
    ],
)
def test_a_refusal_names_file_key_value_and_what_is_allowed(
    write, changes: dict[str, str | None], words: tuple[str, ...]
) -> None:
    path = write(**changes)
    refused(path, path, *words)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"insert__name": '"MRE-99-99"'}, ("MRE-99-99",)),
        ({"insert__name": '"MRE-60-40"'}, ("MRE-60-40",)),
        ({"insert__model": '"no_such_model"'}, ("no_such_model",)),
        ({"insert__model": f'"{"x" * 300}"'}, ("File name too long",)),
        ({"insert__model": '"mine.safetensors"'}, ("mine.safetensors: ",)),
        ({"bandwidth__control_hz": "2000"}, ("rates.control_hz = 1000: allowed is at least 2000",)),
        ({"bandwidth__inference_hz": "750"}, ("rates.inference_hz = 500: allowed is at least 750",)),
        ({"bandwidth__inference_hz": "1000"}, ("rates.inference_hz = 500: allowed is at least 1000",)),
        (
            {"force__most_release_N_s": "3.0"},
            ("allowed is at least 6.56: position.gap_speed_mm_s opens the gap by 38",),
        ),
        ({"force__resolution_N": "0.0005"}, ("force.resolution_N = 0.0005", "at least 0.001", "force sensor")),
        (
            {"force__most_N": "5.0", "force__most_release_N_s": "20.0", "force__resolution_N": "0.0015"},
            ("at least 0.00", "settles to 7 um"),
        ),
        ({"handle__most_mm_s": "400.0"}, ("handle.most_mm_s = 400", "0.46..310", "trained on")),
        ({"force__most_N": "40.0"}, ("force.most_N = 40", "allowed is 0.65..")),
        ({"force__most_N": "0.1"}, ("force.most_N = 0.1", "allowed is 0.65..")),
        ({"force__standby_N": "0.6"}, ("force.standby_N = 0.6", "allowed is above 0.649")),
        ({"force__standby_N": "1.0"}, ("force.standby_N = 1", "to 0.949")),
        ({"signal__bandwidth_hz": "100.0"}, ("miss it by that",)),
        ({"solver__name": '"bisection"'}, ("solver.name", "bisection", "newton")),
        ({"solver__step_mT": "5.0"}, ("solver.step_mT", "5.0", "auto")),
        (
            {"solver__name": '"nearest"', "solver__neighbours": "60", "solver__step_mT": "50.0"},
            ("neighbours", "60", "number of grid points"),
        ),
    ],
)
def test_a_scene_that_does_not_fit_model_device_or_rates_gives_no_core(
    write, tmp_path: Path, changes: dict[str, str], words: tuple[str, ...]
) -> None:
    (tmp_path / "mine.safetensors").write_bytes(b"not a model")
    refused(write(**changes), *words, load=of_path)


@pytest.mark.parametrize("name", INSERTS)
def test_every_insert_of_the_registry_has_a_model_that_stays_in_its_box(write, name: str) -> None:
    core = build_core(Config(scene=write(insert__name=f'"{name}"', insert__model='"auto"', force__most_N="0.8")))
    nominal, box = (
        core.element.nominal,
        load_model(model_path("auto", Path(), name), element="torque", insert=name).feature_ranges,
    )
    low_mT, high_mT = box[FEATURES.index("field_mT")]
    for displacement_mm, rate_mm_s in ((None, None), (0.0, 0.0), (0.3, -300.0), (1e9, 1e9)):
        curve, _ = nominal.planned(TimedSetpoint(0.5, 0.0, 0.1, displacement_mm, rate_mm_s), None)
        asked = curve.displacement_mm, curve.rate_mm_s, low_mT, curve.cip_percent
        assert all(low <= value <= high for value, (low, high) in zip(asked, box, strict=True))
        assert curve.displacement_mm == MOBILISED_MM  # a force is planned for what slides
    fields_mT = [core.element.field.field_mT(gap_mm) for gap_mm in (95.0, 45.0)]
    assert low_mT <= fields_mT[0] < fields_mT[1] <= high_mT


def test_an_insert_whose_iron_the_model_does_not_know_is_refused(write, monkeypatch: pytest.MonkeyPatch) -> None:
    other = msgspec.structs.replace(insert("MRE-50-40"), cip_fraction=0.35)
    monkeypatch.setitem(INSERTS, "MRE-50-40", other)
    refused(write(), "cip_percent = 35.0 is not allowed: a number from 40 to 40", load=of_path)


def test_a_force_that_is_too_fast_for_the_gap_is_refused(write) -> None:
    build_core(Config(scene=write(signal__bandwidth_hz="0.2")))
    with pytest.raises(ConfigError, match=r"at least 0\.[0-9]+: gaps .* and [0-9]+% of the time it is faster"):
        build_core(Config(scene=write(signal__bandwidth_hz="1.0")))


def test_the_scenes_own_gap_speed_counts_where_it_is_the_lower_one(write) -> None:
    slow = {"insert__gap_speed_mm_s": "8.33"}
    refused(write(signal__bandwidth_hz="0.2", **slow), "gaps of 8.33 mm/s", load=of_path)
    of_path(write(signal__bandwidth_hz="0.02", **slow))
    assert of_path(write(force__most_release_N_s="5.5", **slow)).scene.insert.gap_speed_mm_s == 8.33


def test_a_thousand_scenes_are_a_thousand_fingerprints(write) -> None:
    base = load_scene(write())
    steps = [{"most_N": 1.0 + number / 1000} for number in range(1000)]
    steps += [{"tolerance_rms_N": 0.01 + 1e-5 * number} for number in range(1000)]
    forces = [msgspec.structs.replace(base.force, **step) for step in steps]
    assert len({msgspec.structs.replace(base, force=force).fingerprint for force in forces}) == 2000
    assert msgspec.structs.replace(base, name="other", terms=EVERY_TERM.without("rate")).fingerprint == base.fingerprint


def test_terms_are_named_in_the_scene(write) -> None:
    assert load_scene(write()).terms == EVERY_TERM
    named = load_scene(write(terms__rate="false", terms__motor="false")).terms
    assert isinstance(named, Terms)
    assert named.left_out == ("rate", "motor")
    with pytest.raises(ValueError, match="term 'gravity': allowed is one of rate, creep"):
        EVERY_TERM.without("gravity")


def test_a_daemon_may_run_at_the_rates_of_its_scene(write) -> None:
    own = Config(rates=Rates(of_scene=True))
    assert at_rates_of(load_scene("coronary"), Config()) == Config()
    rates = at_rates_of(load_scene(write(bandwidth__control_hz="250", bandwidth__inference_hz="100")), own).rates
    # nothing is watched less often than that
    assert (rates.control_hz, rates.inference_hz, rates.telemetry_hz) == (500, 100, 50)
    assert at_rates_of(load_scene(write(bandwidth__control_hz="2000")), own).rates.control_hz == 2000
    said = "scene bench: rates.of_scene: rates.telemetry_hz = 50"
    refused(write(bandwidth__control_hz="510"), said, load=lambda path: at_rates_of(load_scene(path), own))


@pytest.mark.parametrize(
    ("stated", "is_of_scene"),
    [("", True), ("telemetry_hz = 20", True), ("control_hz = 1000", False), ("inference_hz = 250", False)],
)
def test_a_file_that_states_no_rate_is_at_its_scenes(stated: str, is_of_scene: bool, tmp_path: Path) -> None:
    path = tmp_path / "tormagd.toml"
    path.write_text(f"[rates]\n{stated}\n", encoding="utf-8")
    assert load_config(path).rates.of_scene is is_of_scene
    assert load_config(None).rates.of_scene


def test_a_hold_of_a_day_and_a_recording_at_1_khz_are_taken(write, tmp_path: Path) -> None:
    build_core(Config(scene=write(signal__bandwidth_hz="0.2", signal__hold_s="86400.0")))
    rows = "".join(f"{n / 1000:.3f},{1.2 + 0.3 * (n % 2000) / 2000:.5f}\n" for n in range(2000))
    (tmp_path / "fast.csv").write_text(f"t_s,force_N\n{rows}")
    assert of_path(write(signal__file='"fast.csv"')).missed.rms_N < 1e-3


def run(hz: tuple[int, int], share: float, signal_N: float, contact_N: float = 0.0) -> Served:
    return Served(OperatingPoint(*hz, "newton"), "sample_2", {"signal": signal_N, "contact": contact_N}, share, 50.0)


USUAL, FEW, BOTH, WRONG = (
    run((1000, 500), 0.2, 0.01, 0.3),
    run((500, 83), 0.1, 0.04, 0.31),
    run((500, 500), 0.15, 0.02, 0.3),
    run((500, 100), 0.05, 0.01, 0.32),
)
ALL_HZ = Bandwidth(500, 83)


def test_what_serves_signal_and_worst_like_the_usual_way_at_the_least_rates_or_more_may_be_chosen() -> None:
    served = (USUAL, FEW, BOTH, WRONG)
    assert served_like(served, 0.05, ALL_HZ) == [USUAL, FEW, BOTH]
    assert served_like(served, 0.05, Bandwidth(500, 500)) == [USUAL, BOTH]
    assert served_like(served, 0.03, ALL_HZ) == [USUAL, BOTH]


def test_what_the_judging_device_refuses_is_not_offered_nor_anything_cheaper() -> None:
    chosen = MeasuredScene("", 0.05, 100.0, (USUAL, FEW, BOTH), (run((1000, 500), 0.2, 0.01),))
    assert (chosen.chosen, chosen.offered(ALL_HZ)) == (USUAL, (USUAL,))


def test_a_share_is_scaled_to_the_machine_and_to_the_plans_that_a_publisher_causes() -> None:
    found = MeasuredScene("", 0.05, 100.0, (USUAL, FEW, BOTH), (FEW, USUAL))
    few = FEW.way
    assert [found.share_of(few, 100.0, hz, "can") for hz in (83, 500)] == pytest.approx([0.1, 0.15])
    assert found.share_of(few, 200.0, 83, "can") == pytest.approx(0.2)
    assert found.share_of(few, 200.0, 83, "serial") == pytest.approx(0.185)  # 500 ticks save 30 us each
    assert found.share_of(USUAL.way, 100.0, 1000.0, "can") is None


def test_an_error_is_allowed_within_the_tolerance_or_beside_the_usual_way() -> None:
    assert allowed_N(0.001, 0.05) == TOLERATED * 0.05
    assert allowed_N(0.060, 0.05) == 0.060 + WORSE * 0.05
    assert allowed_N(0.048, 0.05) == 0.05, "what the usual way keeps is kept"


@pytest.mark.parametrize("name", shipped_scenes())
def test_every_shipped_scene_is_measured_and_its_choice_follows_from_its_figures(name: str) -> None:
    scene = load_scene(name)
    found = measured(scene, name)
    assert found is not None
    assert found.tolerance_N == scene.force.tolerance_rms_N
    fits = served_like(found.served, found.tolerance_N, scene.bandwidth)
    cheapest = min(fits, key=lambda each: each.way.sum_hz)
    assert found.chosen == (cheapest if found.judged[0].way == cheapest.way else found.usual)
    assert {each.device for each in found.served}.isdisjoint(each.device for each in found.judged)


def test_a_daemon_runs_at_the_rates_that_measuring_chose_if_they_are_higher(write: Write) -> None:
    path = Path(write(bandwidth__control_hz="500", bandwidth__inference_hz="83"))
    own, scene = Config(scene=str(path), rates=Rates(of_scene=True)), load_scene(str(path))
    found = MeasuredScene(scene.fingerprint, 0.05, 100.0, (USUAL, BOTH), (BOTH, USUAL))
    path.with_suffix(ENDING).write_bytes(msgspec.json.encode(found))
    rates = at_rates_of(scene, own).rates
    assert (rates.control_hz, rates.inference_hz) == (500, 500)
    path.with_suffix(ENDING).write_bytes(b"{}")
    assert at_rates_of(scene, own).rates.inference_hz == 83


@pytest.mark.parametrize(
    "damage",
    [
        {"machine_us": 0.0},
        {"judged": []},
        {"served": []},
        {"served": [msgspec.to_builtins(USUAL) | {"rms_N": {}}]},
        {"fingerprint": "of another scene"},
    ],
    ids=str,
)
def test_damaged_figures_and_those_of_another_scene_are_as_none(write: Write, damage: dict[str, object]) -> None:
    path = Path(write())
    scene = load_scene(str(path))
    found = msgspec.to_builtins(MeasuredScene(scene.fingerprint, 0.05, 100.0, (USUAL, BOTH), (USUAL,)))
    for figures in (found, found | damage):
        path.with_suffix(ENDING).write_bytes(msgspec.json.encode(figures))
        assert (measured(scene, str(path)) is None) == (figures is not found)


# -- the signal --------------------------------------------------------------------------------------------------------


RANGE_N = (0.5, 2.0)


def test_up_and_down_by_half_cosines_with_rests(tmp_path: Path) -> None:
    time_s, force_N = asked(Signal(bandwidth_hz=0.5, hold_s=1.0), tmp_path, RANGE_N, 100.0, 100)
    assert len(time_s) == len(force_N) == 400
    assert force_N[[0, 50, 100, 150, 200, 250, 300, 399]] == pytest.approx([0.5, 1.25, 2.0, 2.0, 2.0, 1.25, 0.5, 0.5])
    # pi f times the range is the steepest slope of such a cosine
    assert np.abs(np.diff(force_N)).max() * 100 == pytest.approx(np.pi * 0.5 * 1.5, rel=1e-3)


def test_steps_divide_the_range_evenly(tmp_path: Path) -> None:
    _, force_N = asked(Signal(bandwidth_hz=5.0, step_N=0.4, hold_s=0.4), tmp_path, RANGE_N, 100.0, 100)
    held_N = np.unique(np.round(force_N[1:][np.diff(force_N) == 0.0], 6))
    assert (held_N, len(force_N)) == (pytest.approx([0.5, 0.875, 1.25, 1.625, 2.0]), 8 * 50)


def test_a_long_hold_is_cut_where_nobody_looks_any_more(tmp_path: Path) -> None:
    time_s, force_N = asked(Signal(bandwidth_hz=1.0, hold_s=86_400.0), tmp_path, RANGE_N, 30.0, 100)
    assert (len(time_s), force_N[-1]) == (3_000, 2.0)


def test_a_recording_is_smooth_between_its_rows_and_keeps_to_the_range(tmp_path: Path) -> None:
    rows_s = np.arange(0.0, 2.001, 0.02)
    lines = [f"{time + 7.0:.3f},{1.2 + 0.9 * np.sin(2.0 * np.pi * time):.6f}" for time in rows_s]
    (tmp_path / "mine.csv").write_text("t_s,force_N\n" + "\n".join(lines) + "\n")
    time_s, force_N = asked(Signal(file="mine.csv"), tmp_path, RANGE_N, 100.0, 500)
    assert time_s[-1] == pytest.approx(2.0, abs=0.003)
    assert force_N == pytest.approx(np.clip(1.2 + 0.9 * np.sin(2.0 * np.pi * time_s), *RANGE_N), abs=5e-4)
