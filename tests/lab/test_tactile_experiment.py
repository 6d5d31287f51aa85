"""The experiment of chapter 4, sampled: that it runs, has the contract's shape, and shows what relaxation does."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from tormagd.lab.main import main
from tormagd.lab.tactile import experiment, models, report
from tormagd.lab.tactile.pads import PADS
from tormagd.lab.tactile.pulse import HELD_S, RATE_HZ, course, program, pulse_shape, recorded_shapes


@pytest.fixture(scope="module")
def run():
    # whole groups left out are only looked at for their shape
    return experiment.contract(replace(models.QUICK, samples_per_cycle=16, hold_samples=140, thin=16, group_epochs=1))


def test_the_contract_s_keys_are_there_and_finite(run):
    figures = run[0]
    table, pulse = figures["table_4_1"], figures["pulse"]
    assert set(table["random"]) == {"r2", "mae_N", "noise_mae_N"}
    assert {"r2", "mae_N"} <= set(table["leave_one_field_out"])
    assert [row["class"] for row in table["rows"]] == ["MRE-A", "MRE-B", "MRE-C", "All"]
    for way in ("mlp", "relaxation_aware"):
        assert {"mae_mT", "max_mT"} <= set(pulse[way])
    for key in ("noise_bound_mae_mT", "scored_share", "hold_1h_force_error"):
        assert math.isfinite(pulse[key])
    assert "NaN" not in json.dumps(figures)
    assert table["synthetic"] is pulse["synthetic"] is True


def test_even_sampled_the_table_beats_the_thesis_and_not_the_noise(run):
    table = run[0]["table_4_1"]
    assert table["random"]["r2"] > 0.97
    assert 0.95 * table["random"]["noise_mae_N"] < table["random"]["mae_N"] < 1.26


def test_without_relaxation_the_field_drifts(run):
    figures, _, traces = run
    pulse, hold = figures["pulse"], figures["pulse"]["hold"]
    assert pulse["mlp"]["mae_mT"] > 3 * pulse["relaxation_aware"]["mae_mT"]
    assert hold["without"]["mean_force_error"] > 3 * hold["with"]["mean_force_error"]
    error = traces["mlp"] - traces["reference"]
    time_s = traces["time_s"]
    early, late = (error[(time_s > start) & (time_s < start + 5.0)].mean() for start in (5.0, 21.0))
    assert late < early - 5.0


def test_the_page_and_its_pictures_are_written(run, tmp_path):
    report.write_report(tmp_path, *run)
    page = (tmp_path / "learned_inverse.md").read_text(encoding="utf-8")
    assert "synthetic" in page
    for line in page.splitlines():
        if line.startswith("!["):
            assert (tmp_path / line[line.index("(") + 1 : -1]).read_bytes().startswith(b"\x89PNG")
    assert page.count("![") == 2


def test_arterial_pulses_are_read_where_the_recordings_are(recordings, monkeypatch):
    monkeypatch.setenv("TORMAG_DATA", str(recordings))
    shapes = recorded_shapes(10.0, 160)
    assert shapes
    for shape in shapes.values():
        assert len(shape) == 1600
        assert (shape.min(), shape.max()) == (0.0, 1.0)
        assert np.abs(np.diff(shape)).max() < 0.25
    monkeypatch.delenv("TORMAG_DATA")
    assert recorded_shapes(10.0, 160) == {}


def test_the_program_is_the_thesis_s():
    done = program(pulse_shape(HELD_S, RATE_HZ))
    assert len(done.time_s) == 4322
    held = done.displacement_mm == 4.5
    assert done.rate_mm_s[~held] == pytest.approx(1.0)
    assert not done.rate_mm_s[held][1:].any()
    assert (done.field_mT[held].min(), done.field_mT[held].max()) == pytest.approx((100.0, 200.0))


def test_field_errors_count_only_where_the_force_depends_on_the_field():
    along = course(PADS["MRE-C"], pulse_shape(HELD_S, RATE_HZ), 20)
    reference = along.features[:, 2]
    scores = along.scores(np.where(along.scored, reference + 2.0, 300.0))
    assert scores["mae_mT"] == pytest.approx(2.0)
    assert scores["elsewhere_force_mae_N"] > 0.0
    assert along.scores(reference)["elsewhere_force_mae_N"] == 0.0
    # near no displacement nothing does
    assert not along.scored[0]


def test_another_place_than_a_folder_is_refused(tmp_path, capsys):
    assert main(["tactile-experiment", "--out", str(tmp_path / "none")]) == 2
    assert "not a directory" in capsys.readouterr().err
