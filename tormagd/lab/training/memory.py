"""The memory of recorded data: what a Prony series makes of a force without memory, along records of any spacing."""

import itertools

import numpy as np

from tormagd.lab.arrays import Array
from tormagd.lab.training.dataset import Dataset
from tormagd.physics.errors import DomainError
from tormagd.physics.relaxation import PronySeries


def records(time_s: Array) -> list[slice]:
    """Return the rows of each record in times (n), in order: a new one begins wherever time goes back."""
    starts = [0, *(np.flatnonzero(np.diff(time_s) < 0) + 1).tolist(), len(time_s)]
    return [slice(first, last) for first, last in itertools.pairwise(starts)]


def times_of(data: Dataset) -> Array:
    """Return `time_s` of the data. Raises `DomainError` where they have none."""
    if data.time_s is None:
        raise DomainError("time_s", None, "a column of the data: a model with memory needs it")
    return data.time_s


def relaxed_N(series: PronySeries, elastic_N: Array, data: Dataset) -> Array:
    """Return the force with memory (n), N, from the force without, `elastic_N` (n), along the records of `data`.

    Of `data` only the times count. `time_s` counts from the last rest. A record that begins later counts as having been
    run before, from the rest on, as often as the time allows. Laboratories cycle a specimen until it repeats and then
    record. Raises `DomainError` without `time_s`.
    """
    times = times_of(data)
    # records with the same times run side by side: a laboratory repeats one program, and rows are slow one by one
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
    """Return the force with memory (n x r), N, of r records with the same times `time_s` (n), s from the last rest.

    `driving_N` (n x r) is the force without memory. A first time above 0 makes the first step a ramp as long as the
    second; from 0 it is a jump.
    """
    first_s = float(time_s[1] - time_s[0]) if len(time_s) > 1 and time_s[0] > 0 else 0.0
    # rounded, so that steps that are equal but for the rounding of the time share one update
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
