"""The training tool, from a synthetic CSV to a model file that loads."""

import json
from pathlib import Path

import numpy as np
import pytest

from tormagd.lab.main import main
from tormagd.lab.training import train_model
from tormagd.lab.training.dataset import Dataset, read_csv, write_csv
from tormagd.model.memory import NO_MEMORY, Memory
from tormagd.model.model_file import load_model


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic torque element: pre-sliding, rate and field as smooth formulas, 0.01 N of noise, one insert."""
    rng = np.random.default_rng(0)
    rows = 3000
    displacement, rate, field = rng.uniform((0, 0, 100), (1, 60, 800), (rows, 3)).T
    slip = 1 - np.exp(-displacement / 0.15)
    force = slip * (0.3 + 4.6 * (field / 800) ** 2.2) * (1 + 0.2 * np.exp(-rate / 12)) + rng.normal(0, 0.01, rows)
    features = np.column_stack((displacement, rate, field, np.full(rows, 40.0)))
    path = tmp_path_factory.mktemp("data") / "synthetic.csv"
    write_csv(path, Dataset(features, force, np.arange(rows) // 50))
    return path


def command(data: Path, out: Path, *more: str) -> list[str]:
    required = ["train-model", str(data), "--element", "torque", "--insert", "MRE-50-40", "--out", str(out)]
    return [*required, "--hidden", "15", "--epochs", "40", "--created", "2024-01-01", *more]


def test_from_csv_to_model(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "model.safetensors"
    assert main(command(data, out, "--json")) == 0
    report = json.loads(capsys.readouterr().out)
    model = load_model(out, element="torque", insert="MRE-50-40")
    assert report["validation_r2"] > 0.999
    assert report["validation_mae_N"] < 0.015
    assert 0 < report["train_mae_percent"] < 1
    assert 0 <= report["not_rising_share"] < 0.2
    assert (report["train_rows"], report["data_sha256"]) == (2100, model.metadata.training_data_sha256)
    assert model.metadata.metrics["validation_r2"] == report["validation_r2"]
    assert model.predict_one(1.0, 60.0, 800.0, 40.0) == pytest.approx(4.9, abs=0.05)


def test_several_inserts_are_told_apart_by_their_iron(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = read_csv(data)
    weak = rows.features.copy()
    weak[:, 2:] = weak[:, 2:] / 2.0  # half the field, half the iron
    assert rows.cycle is not None
    joined = Dataset(
        np.concatenate((rows.features, weak)),
        np.concatenate((rows.force_N, rows.force_N / 3.0)),
        np.concatenate((rows.cycle, rows.cycle + 100)),
    )
    both, out = tmp_path / "both.csv", tmp_path / "model.safetensors"
    write_csv(both, joined)
    arguments = [*command(both, out, "--rising", "--epochs", "10"), "--insert", "MRE-50-20", "MRE-50-40"]
    assert main(arguments) == 0
    whole, strong = (load_model(out, element="torque", insert=name) for name in (None, "MRE-50-40"))
    assert (whole.metadata.insert, whole.metadata.ranges["cip_percent"]) == ("MRE-50", (20.0, 40.0))
    assert (strong.metadata.ranges["cip_percent"], strong.field_range_mT[1]) == (
        (40.0, 40.0),
        pytest.approx(800.0, rel=0.01),
    )
    assert load_model(out, element="torque", insert="MRE-50-20").field_range_mT[1] == pytest.approx(400.0, rel=0.01)
    assert whole.metadata.metrics["not_rising_share"] == 0.0
    assert main([*arguments[:-1], "MRE-50-30"]) == 2
    assert "insert = MRE-50-30 is not allowed: one that there are rows of" in capsys.readouterr().err


def test_the_same_command_gives_the_same_bytes(data: Path, tmp_path: Path) -> None:
    written = []
    for seed in ("1", "1", "2"):
        assert main(command(data, tmp_path / "m.safetensors", "--epochs", "5", "--seed", seed)) == 0
        written.append((tmp_path / "m.safetensors").read_bytes())
    assert written[0] == written[1] != written[2]


def test_what_was_taken_out_of_the_data_is_in_the_file(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = Memory(fractions=(0.05,), times_s=(8.0,), lag_mT=7.0, turn_mT=70.0)
    monkeypatch.setattr(train_model, "identify", lambda rows: (memory, rows))
    for name, more, expected in (("with", ["--without-memory"], memory), ("plain", [], NO_MEMORY)):
        out = tmp_path / f"{name}.safetensors"
        assert main(command(data, out, "--epochs", "2", *more)) == 0
        assert load_model(out, element="torque").metadata.memory == expected


def test_what_cannot_work_is_told_with_exit_2(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "m.safetensors"
    broken = tmp_path / "broken.csv"
    broken.write_text("displacement_mm,rate_mm_s,field_mT,cip_percent,force_N\n0,0,nan,40,1\n")
    for arguments, message in (
        (command(broken, out), "row 2, field_mT: 'nan'"),
        (command(tmp_path / "absent.csv", out), "cannot be read"),
        (command(data, tmp_path / "absent" / "m.safetensors", "--epochs", "1"), "cannot write"),
        (command(data, out, "--hidden", "0"), "hidden = 0"),
        (command(data, out, "--epochs", "0"), "epochs = 0"),
        (command(data, out, "--insert", "two words"), "insert"),
        (command(data, out, "--validation-share", "1"), "validation_share"),
    ):
        assert main(arguments) == 2
        assert message in capsys.readouterr().err
    assert not out.exists()
