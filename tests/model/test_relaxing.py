"""What a model knows of relaxation: the same as the laboratory's grey box, and it survives its file."""

import dataclasses
from pathlib import Path

import msgspec
import numpy as np
import pytest

from tormagd.model.model_file import ModelFileError, Relaxation, load_model, save_model
from tormagd.model.relaxing import Relaxing
from tormagd.model.shipped import model_path
from tormagd.physics.errors import DomainError
from tormagd.physics.relaxation import PronySeries
from tormagd.training.grey_box import GreyBox, GreyBoxMemory

HERE = Path(__file__).parent
SERIES, FIELD_SERIES = PronySeries((0.05, 0.04), (1.0, 30.0)), PronySeries((0.1, 0.02), (1.0, 30.0))


def test_an_elastomer_that_is_held_loses_its_shares_and_no_more() -> None:
    relaxing = Relaxing(SERIES, FIELD_SERIES)
    memory = relaxing.rested(5.0)
    assert memory.lost_N == 0.0
    memory = relaxing.advance(memory, 5.0, 2.0, 1.0)
    assert memory.lost_N == pytest.approx(0.0)
    memory = relaxing.advance(memory, 1e4, 2.0, 1.0)
    assert memory.lost_N == pytest.approx(2.0 * 0.09 + 1.0 * 0.12)
    # let go, it pulls for a while: what had relaxed has to come back
    assert relaxing.advance(memory, 1e4 + 0.01, 0.0, 0.0).lost_N == pytest.approx(2.0 * 0.09 + 1.0 * 0.12, rel=0.01)


def test_time_that_goes_back_ages_nothing() -> None:
    relaxing = Relaxing(SERIES, FIELD_SERIES)
    memory = relaxing.advance(relaxing.rested(10.0), 11.0, 2.0, 1.0)
    assert relaxing.advance(memory, 10.0, 2.0, 1.0).lost_N == pytest.approx(memory.lost_N)


def test_the_daemon_remembers_what_the_grey_box_does() -> None:
    model = load_model(model_path("tactile_mre_c", HERE), element="tactile")
    assert model.relaxing is not None
    known = model.metadata.relaxation
    assert isinstance(known, Relaxation)
    grey = GreyBox(
        model, PronySeries(known.fractions, known.times_s), PronySeries(known.field_fractions, known.times_s)
    )
    lab, memory = GreyBoxMemory(grey, 0.01), model.relaxing.rested(0.0)
    draw = np.random.default_rng(4)
    for step in range(1, 300):
        place = min(0.01 * step, 2.0), 0.3, float(draw.uniform(140.0, 360.0))
        expected_N = lab.advance(*place, 45.0)
        curve = model.curve(*place[:2], 45.0)
        whole_N, free_N = curve.force_N(place[2]), curve.force_N(0.0)
        memory = model.relaxing.advance(memory, 0.01 * step, free_N, whole_N - free_N)
        assert whole_N - memory.lost_N == pytest.approx(expected_N, abs=1e-6)


def test_relaxation_survives_its_file_and_is_part_of_the_fingerprint(tmp_path: Path) -> None:
    model = load_model(model_path("tactile_mre_c", HERE), element="tactile", insert="MRE-C")
    save_model(tmp_path / "same.safetensors", model)
    again = load_model(tmp_path / "same.safetensors", element="tactile")
    assert again.metadata == model.metadata
    assert again.fingerprint == model.fingerprint
    forgetful = dataclasses.replace(model, metadata=msgspec.structs.replace(model.metadata, relaxation=msgspec.UNSET))
    assert forgetful.relaxing is None
    assert forgetful.fingerprint != model.fingerprint
    save_model(tmp_path / "none.safetensors", forgetful)
    assert load_model(tmp_path / "none.safetensors", element="tactile").relaxing is None


def test_a_pads_model_is_not_a_brakes() -> None:
    with pytest.raises(ModelFileError, match="trained on the tactile element, but the torque element is in use"):
        load_model(model_path("tactile_mre_c", HERE), element="torque")


@pytest.mark.parametrize("fractions", [(0.6, 0.6), (0.1,), (-0.1, 0.1)])
def test_series_that_cannot_be_are_refused(fractions: tuple[float, ...]) -> None:
    with pytest.raises(DomainError):
        Relaxation((1.0, 10.0), fractions, (0.1, 0.1))
