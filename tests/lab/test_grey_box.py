"""The relaxation-aware model on a small synthetic element with a known memory."""

from dataclasses import replace

import numpy as np
import pytest

from tormagd.inverse.nearest import NearestFieldSearch, field_grid
from tormagd.lab.training.dataset import Dataset
from tormagd.lab.training.fitting import fit_network
from tormagd.lab.training.grey_box import GreyBox, GreyBoxMemory, fit_grey_box, fit_series, relaxed_N
from tormagd.physics.errors import DomainError
from tormagd.physics.relaxation import PronySeries

SERIES = PronySeries((0.02, 0.06, 0.04, 0.03), (1.2, 9.0, 120.0, 900.0))
FIELD_SERIES = PronySeries((0.03, 0.09, 0.05, 0.02), (1.2, 9.0, 120.0, 900.0))
NOISE_N = 0.02


def parts(features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    displacement, rate, field, _ = features.T
    free = 4 * displacement * (1 + 0.1 * displacement) * (1 + 0.02 * rate)
    return free, free * 0.5 * (field / 300) ** 2


def records(displacement: np.ndarray, time_s: np.ndarray, fields: tuple[float, ...]) -> Dataset:
    """The element pressed alike at each field, with noise."""
    rate = np.gradient(displacement, time_s)
    pressed, field = np.column_stack((displacement, rate)), np.repeat(fields, len(time_s))
    features = np.column_stack((np.tile(pressed, (len(fields), 1)), field, np.full_like(field, 45)))
    cycle = np.arange(len(field)) // (len(time_s) // 4)
    empty = Dataset(features, np.zeros(len(field)), cycle, np.tile(time_s, len(fields)))
    free, added = parts(features)
    force = relaxed_N(SERIES, free, empty) + relaxed_N(FIELD_SERIES, added, empty)
    return replace(empty, force_N=force + np.random.default_rng(0).normal(0, NOISE_N, len(force)))


@pytest.fixture(scope="module")
def cycles() -> Dataset:
    time_s = np.arange(1, 401) * 0.1
    return records(2 - 2 * np.cos(2 * np.pi * time_s / 10), time_s + 200, (0.0, 75.0, 150.0, 225.0, 300.0))


@pytest.fixture(scope="module")
def holds() -> Dataset:
    time_s = np.concatenate((np.linspace(0, 4, 21), 4 + np.geomspace(0.1, 3600, 120)))
    return records(np.minimum(time_s, 4.0), time_s, (0.0, 150.0, 300.0))


@pytest.fixture(scope="module")
def grey(cycles: Dataset, holds: Dataset) -> GreyBox:
    return fit_grey_box(cycles, np.ones(len(cycles), dtype=bool), holds, hidden=20, epochs=40, settling_epochs=20)


def test_a_series_is_recovered_from_holds_even_when_the_level_is_wrong(holds: Dataset) -> None:
    free, added = parts(holds.features)
    found, field_found = fit_series(holds, (1.05 * free, 1.05 * added))
    assert (found.times_s, found.fractions) == (
        pytest.approx(SERIES.times_s, rel=0.2),
        pytest.approx(SERIES.fractions, abs=0.01),
    )
    assert sum(field_found.fractions) == pytest.approx(sum(FIELD_SERIES.fractions), abs=0.03)


def test_records_that_begin_late_were_run_before() -> None:
    # a constant force: after n passes of 10 s it has relaxed for n * 10 s
    for passes in (0, 3):
        data = Dataset(np.zeros((10, 4)), np.zeros(10), None, np.arange(1.0, 11.0) + 10 * passes)
        force = relaxed_N(PronySeries((0.5,), (20.0,)), np.full(10, 8.0), data)
        ramp = 20.0 * (1 - np.exp(-1 / 20.0))  # the first step is a ramp of 1 s
        remembered = 4.0 * ramp * np.exp(-(9 + 10 * passes) / 20.0)
        assert force[-1] == pytest.approx(4.0 + remembered, rel=1e-9)


def test_the_grey_box_sees_through_the_memory(grey: GreyBox, cycles: Dataset, holds: Dataset) -> None:
    alone, _ = fit_network(cycles, np.ones(len(cycles), dtype=bool), 20, epochs=40)
    error, error_alone = (
        np.abs(found_N - holds.force_N).mean() for found_N in (grey.predict(holds), alone.predict(holds.features))
    )
    assert 5 * error < error_alone
    assert error < 3 * NOISE_N


def test_the_memory_inverts_itself(grey: GreyBox) -> None:
    model = grey.model
    memory, told = GreyBoxMemory(grey, 0.5), GreyBoxMemory(grey, 0.5)
    solver = NearestFieldSearch(field_grid((0.0, 300.0), 1.0))
    last = None
    for step in range(200):
        field = 180 + 60 * np.sin(step / 9)
        force = told.advance(3.5, 0.0, field, 45.0)
        last = solver.solve(model.curve(3.5, 0.0, 45.0), memory.elastic_N(3.5, 0.0, force, 45.0), last).field_mT
        assert last == pytest.approx(field, abs=0.1)
        memory.advance(3.5, 0.0, last, 45.0)


def test_steps_and_records_agree(grey: GreyBox) -> None:
    fields = 150 + 100 * np.sin(np.arange(1, 41) / 5)
    features = np.column_stack((np.full(40, 3.0), np.zeros(40), fields, np.full(40, 45.0)))
    data = Dataset(features, np.zeros(40), None, np.arange(1, 41) * 0.25 - 0.25)
    memory = GreyBoxMemory(grey, 0.25)
    stepped = [memory.advance(3.0, 0.0, field, 45.0) for field in fields.tolist()]
    # the record begins with a jump, the steps with a ramp: what is left of the difference fades
    assert grey.predict(data)[1:] == pytest.approx(stepped[1:], rel=5e-3)


def test_a_memory_needs_times(grey: GreyBox, cycles: Dataset) -> None:
    with pytest.raises(DomainError, match="time_s"):
        grey.predict(Dataset(cycles.features, cycles.force_N))


def test_forces_held_out_are_not_looked_at(cycles: Dataset) -> None:
    known = np.arange(len(cycles)) % 3 > 0
    spoiled = Dataset(cycles.features, np.where(known, cycles.force_N, 900.0), cycles.cycle, cycles.time_s)
    models = [fit_network(data, known, 5, epochs=3)[0].predict(cycles.features) for data in (cycles, spoiled)]
    assert models[0] == pytest.approx(models[1])
