"""What a model knows of relaxation: the same as the laboratory's grey box, and it survives its file."""

import dataclasses
from pathlib import Path

import msgspec
import numpy as np
import pytest

from tormagd.assembly.build import build_core
from tormagd.config import Config, Rates
from tormagd.control.believe.memory import ElementMemory
from tormagd.control.records import Handle, Measured
from tormagd.lab.training.grey_box import GreyBox, GreyBoxMemory
from tormagd.model.displacement import Turn
from tormagd.model.memory import NO_MEMORY, Memory
from tormagd.model.model_file import load_model, save_model
from tormagd.model.shipped import model_path
from tormagd.physics.errors import DomainError

HERE = Path(__file__).parent


def test_the_daemon_remembers_what_the_grey_box_does() -> None:
    model = load_model(model_path("tactile_mre_c", HERE), element="tactile")
    grey = GreyBox(model, model.metadata.memory.free, model.metadata.memory.added)
    element = build_core(Config(scene="radial_pulse", rates=Rates(control_hz=500, inference_hz=83))).element
    gap_range_mm = element.portrait.gap_mm[-1], element.portrait.gap_mm[0]
    lab, memory = GreyBoxMemory(grey, 0.01), ElementMemory(element.memory, element.nominal, element.field, gap_range_mm)
    # after a long rest without load
    memory.free, memory.added = element.memory.free.relaxed(0.0), element.memory.added.relaxed(0.0)
    memory.field_mT, memory.time_s = 140.0, 0.0
    draw = np.random.default_rng(4)
    for step in range(1, 300):
        place = min(0.01 * step, 2.0), 0.3, float(draw.uniform(140.0, 360.0))
        expected_N = lab.advance(*place, 45.0)
        at_mm, handle = element.field.gap_mm(place[2]) / 2.0, Handle(*place[:2], Turn(1.0, 0.0, 0.0))
        seen = Measured(step, True, 0.0, at_mm, at_mm, 0.0, 0.0, 0.0, handle, 0.0, 0.0, 0.0)
        memory.update(0.01 * step, seen)
        assert memory.force_N(element.nominal.now(seen)) == pytest.approx(expected_N, abs=1e-6)


def test_memory_survives_its_file_and_is_part_of_the_fingerprint(tmp_path: Path) -> None:
    model = load_model(model_path("tactile_mre_c", HERE), element="tactile", insert="MRE-C")
    save_model(tmp_path / "same.safetensors", model)
    again = load_model(tmp_path / "same.safetensors", element="tactile")
    assert again.metadata == model.metadata
    assert again.fingerprint == model.fingerprint
    forgetful = dataclasses.replace(model, metadata=msgspec.structs.replace(model.metadata, memory=NO_MEMORY))
    assert forgetful.fingerprint != model.fingerprint


@pytest.mark.parametrize("fractions", [(0.6, 0.6), (0.1,), (-0.1, 0.1)])
def test_series_that_cannot_be_are_refused(fractions: tuple[float, ...]) -> None:
    with pytest.raises(DomainError):
        Memory(times_s=(1.0, 10.0), fractions=fractions)
    with pytest.raises(DomainError):
        Memory(times_s=(1.0, 10.0), fractions=(0.1, 0.1), field_fractions=fractions)
