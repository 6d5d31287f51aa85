"""The relaxation-aware model: a network for the force without memory, and Prony series for the stress's relaxation.

F0 = NN(displacement, rate, field, CIP) is the force without memory. Its part without field and what the field adds
relax by fractions of their own, with the same times (see `tormagd.element.physics.relaxation`). For an inverse, the
memory is a shift. `GreyBoxMemory.elastic_N` says which F0 gives the force that is asked now, and any search finds the
field for it.
"""

import functools
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from tormag_lab.arrays import Array, Mask
from tormag_lab.training.dataset import Dataset, records, times_of
from tormagd.element.model.features import FIELD, RATE
from tormagd.element.model.model_file import ForceModel
from tormagd.element.physics.relaxation import PronySeries

START_TIMES_S = (1.0, 10.0, 100.0, 1000.0)
START_FRACTION = 0.03
TIME_SPREAD = 3.0
"""Fitted times stay within this factor of their starts, so that they cannot change places."""
ROUNDS = 4
"The network learns from forces freed of memory, which it predicts itself, and so has to settle."


@dataclass(frozen=True)
class GreyBox:
    """A network for the force without memory, and relaxation of its field-free part and of what the field adds."""

    model: ForceModel
    series: PronySeries
    field_series: PronySeries

    def predict(self, data: Dataset) -> Array:
        return _with_memory((self.series, self.field_series), elastic_parts_N(self.model, data), data)


class GreyBoxMemory:
    """Relaxation state of a pad while it is driven, in steps of `dt_s`, beginning at rest."""

    def __init__(self, grey: GreyBox, dt_s: float) -> None:
        self._model = grey.model
        self._step, self._field_step = grey.series.discretise(dt_s), grey.field_series.discretise(dt_s)
        self._state, self._field_state = grey.series.relaxed(0.0), grey.field_series.relaxed(0.0)

    def elastic_N(self, displacement_mm: float, rate_mm_s: float, force_N: float, cip_percent: float) -> float:
        """Return the force without memory that gives `force_N` at the end of the next step."""
        free_N = self._model.predict_one(displacement_mm, rate_mm_s, 0.0, cip_percent)
        rest_N, _ = self._step.advance(self._state, free_N)
        # the force is affine in the driving one: take its value at 0 and its slope
        step, state = self._field_step, self._field_state
        past_N, _ = step.advance(state, 0.0)
        gain = step.equilibrium_fraction + sum(g * k for g, k in zip(step.fractions, step.gains, strict=True))
        return free_N + (force_N - rest_N - past_N) / gain

    def advance(self, displacement_mm: float, rate_mm_s: float, field_mT: float, cip_percent: float) -> float:
        """Take one step to this motion and field, and return the force expected at its end."""
        free_N = self._model.predict_one(displacement_mm, rate_mm_s, 0.0, cip_percent)
        whole_N = self._model.predict_one(displacement_mm, rate_mm_s, field_mT, cip_percent)
        rest_N, self._state = self._step.advance(self._state, free_N)
        added_N, self._field_state = self._field_step.advance(self._field_state, whole_N - free_N)
        return rest_N + added_N


def elastic_parts_N(model: ForceModel, data: Dataset) -> tuple[Array, Array]:
    """Return both parts (n each) of the force without memory: without field, and what the field adds."""
    fieldless = data.features.copy()
    fieldless[:, FIELD] = 0.0
    free_N = model.predict(fieldless)
    return free_N, model.predict(data.features) - free_N


def _with_memory(series: tuple[PronySeries, PronySeries], parts: tuple[Array, Array], data: Dataset) -> Array:
    return relaxed_N(series[0], parts[0], data) + relaxed_N(series[1], parts[1], data)


def relaxed_N(series: PronySeries, elastic_N: Array, data: Dataset) -> Array:
    """Return the force with memory (n) from the force without, along the records."""
    times = times_of(data)
    # records with equal times run side by side, as rows are slow one by one
    alike: dict[bytes, list[slice]] = {}
    for rows in records(times):
        alike.setdefault(times[rows].tobytes(), []).append(rows)
    forces = np.empty(len(data))
    for group in alike.values():
        relaxed = _relax_alike(series, np.column_stack([elastic_N[rows] for rows in group]), times[group[0]])
        for rows, column in zip(group, relaxed.T, strict=True):
            forces[rows] = column
    return forces


def _relax_alike(series: PronySeries, driving_N: Array, time_s: Array) -> Array:
    """Return the force with memory (n x r) of r records with equal times (n)."""
    first_s = float(time_s[1] - time_s[0]) if len(time_s) > 1 and time_s[0] > 0 else 0.0
    # rounded, so that steps that are equal but for rounding share one update
    steps_s = np.round(np.diff(time_s, prepend=time_s[0] - first_s), 9).tolist()
    known = {dt_s: series.discretise(dt_s) for dt_s in set(steps_s)}
    decays = np.array([known[dt_s].decays for dt_s in steps_s])[:, :, np.newaxis]
    gains = np.array([known[dt_s].gains for dt_s in steps_s])[:, :, np.newaxis]
    duration_s = float(time_s[-1] - time_s[0]) + first_s
    passes = 1 + (round((float(time_s[0]) - first_s) / duration_s) if duration_s > 0 else 0)
    last_N = np.zeros(driving_N.shape[1])
    branches = np.zeros((len(series.times_s), driving_N.shape[1]))
    fractions = np.array(series.fractions)
    remembered = np.empty_like(driving_N)
    for _ in range(passes):
        for row, now_N in enumerate(driving_N):
            branches = branches * decays[row] + (now_N - last_N) * gains[row]
            remembered[row] = fractions @ branches
            last_N = now_N
    return (1.0 - sum(series.fractions)) * driving_N + remembered


def fit_series(holds: Dataset, parts: tuple[Array, Array]) -> tuple[PronySeries, PronySeries]:
    """Fit the relaxation of both parts of the force to `holds`, a series each with the same times."""
    at_rest = holds.features[:, RATE] == 0.0
    still_rows = [np.flatnonzero(at_rest[rows]) + rows.start for rows in records(times_of(holds))]
    terms = len(START_TIMES_S)

    def series(parameters: Array) -> tuple[PronySeries, PronySeries]:
        fractions, added, times = (tuple(part.tolist()) for part in np.split(parameters, 3))
        times_s = tuple(np.exp(times).tolist())
        return PronySeries(fractions, times_s), PronySeries(added, times_s)

    @functools.cache
    def branches(time_s: float) -> tuple[Array, Array]:
        # fractions enter linearly, so only a changed time costs a run along the records
        single = PronySeries((0.5,), (time_s,))
        return 2 * relaxed_N(single, parts[0], holds) - parts[0], 2 * relaxed_N(single, parts[1], holds) - parts[1]

    def residual(parameters: Array) -> Array:
        shape = parts[0] + parts[1]
        for first, second, time_s in zip(*np.split(parameters, 3), strict=True):
            free_N, added_N = branches(float(np.exp(time_s)))
            shape = shape + first * (free_N - parts[0]) + second * (added_N - parts[1])
        errors = []
        for rows in still_rows:
            measured, made = holds.force_N[rows], shape[rows]
            errors.append(made * (made @ measured) / (made @ made) - measured)
        return np.concatenate(errors)

    times, spread = np.log(START_TIMES_S), np.log(TIME_SPREAD)
    start = np.concatenate((np.full(2 * terms, START_FRACTION), times))
    low = np.concatenate((np.zeros(2 * terms), times - spread))
    high = np.concatenate((np.full(2 * terms, 0.3), times + spread))
    scale = np.repeat((0.01, 0.01, 0.3), terms)
    return series(least_squares(residual, start, bounds=(low, high), x_scale=scale, ftol=1e-6).x)


def fit_grey_box(
    data: Dataset, known: Mask, holds: Dataset, *, hidden: int = 30, epochs: int = 100, settling_epochs: int = 30
) -> GreyBox:
    """Fit the model to the rows `known` of `data`, and to the relaxation tests `holds`."""
    from tormag_lab.training.fitting import fit_network  # loads torch, which a fitted model does without

    model, _ = fit_network(data, known, hidden, epochs)
    for _ in range(ROUNDS):
        parts, parts_holds = elastic_parts_N(model, data), elastic_parts_N(model, holds)
        series = fit_series(holds, parts_holds)
        lost = sum(parts) - _with_memory(series, parts, data)
        lost_holds = sum(parts_holds) - _with_memory(series, parts_holds, holds)
        joined = Dataset(
            np.concatenate((data.features, holds.features)),
            np.concatenate((data.force_N + lost, holds.force_N + lost_holds)),
        )
        all_known = np.concatenate((known, np.ones(len(holds), dtype=np.bool_)))
        model, _ = fit_network(joined, all_known, hidden, settling_epochs, start=model)
    return GreyBox(model, *series)
