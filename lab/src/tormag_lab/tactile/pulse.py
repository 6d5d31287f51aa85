"""The pulse experiment of section 4.3 on the synthetic pad, and pulses rendered on a pad held for an hour."""

from typing import NamedTuple

import numpy as np

from tormag_lab.arrays import Array, Json, Mask
from tormag_lab.human_pulse import pulse_profile, scaled
from tormag_lab.tactile.models import (
    NOISE_N,
    PAD_IN_USE,
    SCORED_SLOPE_N_MT,
    Effort,
    Trained,
    plant_force_N,
    slope_N_per_mT,
)
from tormag_lab.tactile.pads import PADS, Program
from tormag_lab.training.grey_box import GreyBoxMemory
from tormagd.element.inverse.nearest import NearestFieldSearch, field_grid
from tormagd.element.inverse.solution import FieldSolution, FieldSolver
from tormagd.element.model.model_file import ForceModel
from tormagd.simulation.parameters import PadParameters
from tormagd.simulation.tactile_pad import FULL_FIELD_MT, FULL_INDENTATION_MM, worked_pad

SAMPLES = 4322
RATE_HZ = 160
"Gives as many samples as the thesis has, from the 25 s of measured pulse."
REFERENCE_FIELDS_MT = (100.0, 200.0)
FIELDS_MT = (0.0, FULL_FIELD_MT)
SHAPE = "measured photoplethysmogram (heartpy)"

HOLD_RATE_HZ = 10
HOLD_FORCES_N = (148.0, 154.0)
"Forces that the field reaches both at first and after an hour of relaxation."
HELD_PULSE_S = 20.0


def pulse_shape(duration_s: float, rate_hz: int) -> Array:
    """Return a measured pulse (n) between 0 and 1."""
    return pulse_profile(duration_s, 0.0, 1.0, rate_hz)[1]


def program(shape: Array) -> Program:
    """Return the experiment's program: indentation to 4.5 mm at 1 mm/s, then a hold under the field `shape`."""
    time_s = np.arange(1, SAMPLES + 1) / RATE_HZ
    displacement_mm = np.minimum(time_s, FULL_INDENTATION_MM)
    rate_mm_s = np.diff(displacement_mm, prepend=0.0) * RATE_HZ
    low, high = REFERENCE_FIELDS_MT
    pulse_mT = low + (high - low) * shape
    return Program(
        time_s, displacement_mm, rate_mm_s, np.concatenate((np.full(SAMPLES - len(shape), pulse_mT[0]), pulse_mT))
    )


HELD_S = (SAMPLES - FULL_INDENTATION_MM * RATE_HZ) / RATE_HZ


def solve_all(
    solver: FieldSolver, model: ForceModel, features: Array, force_N: Array, memory: GreyBoxMemory | None
) -> list[FieldSolution]:
    """Find the field for each force (n) in turn, each search from the last answer on."""
    answers: list[FieldSolution] = []
    for row, wanted_N in zip(features.tolist(), force_N.tolist(), strict=True):
        displacement_mm, rate_mm_s, _, cip_percent = row
        if memory is not None:
            wanted_N = memory.elastic_N(displacement_mm, rate_mm_s, wanted_N, cip_percent)
        curve = model.curve(displacement_mm, rate_mm_s, cip_percent)
        answers.append(solver.solve(curve, wanted_N, answers[-1].field_mT if answers else None))
        if memory is not None:
            # the pad feels the field that was found, not the wish
            memory.advance(displacement_mm, rate_mm_s, answers[-1].field_mT, cip_percent)
    return answers


def fields_of(answers: list[FieldSolution]) -> Array:
    return np.array([answer.field_mT for answer in answers])


class Course(NamedTuple):
    """The pulse experiment on one pad: the rows to solve, and the pad's slope at each."""

    pad: PadParameters
    features: Array
    force_N: Array
    slope_N_mT: Array
    dt_s: float

    @property
    def scored(self) -> Mask:
        return self.slope_N_mT >= SCORED_SLOPE_N_MT

    def scores(self, fields_mT: Array) -> dict[str, float]:
        """Return the field error over the scored rows, mT, and the force error over the others, N."""
        absolute = np.abs(fields_mT - self.features[:, 2])[self.scored]
        pad, places = worked_pad(self.pad), self.features[~self.scored, :3].copy()
        right_N = plant_force_N(pad, places)
        places[:, 2] = fields_mT[~self.scored]
        return {
            "mae_mT": float(absolute.mean()),
            "sd_mT": float(absolute.std()),
            "max_mT": float(absolute.max()),
            "elsewhere_force_mae_N": float(np.abs(plant_force_N(pad, places) - right_N).mean()),
        }


def course(pad: PadParameters, shape: Array, every: int = 1) -> Course:
    done = program(shape)
    force_N = worked_pad(pad).run(*done)
    features = done.features(pad.cip_percent)[::every]
    return Course(pad, features, force_N[::every], slope_N_per_mT(pad, features[:, :3]), every / RATE_HZ)


def nearest() -> NearestFieldSearch:
    return NearestFieldSearch(field_grid(FIELDS_MT, 2.0))


def pulse(trained: Trained, effort: Effort) -> Json:
    """Return scores of the network alone and of the relaxation-aware model."""
    along = course(PADS[PAD_IN_USE], pulse_shape(HELD_S, RATE_HZ), effort.pulse_every)
    aware = GreyBoxMemory(trained.grey, along.dt_s)
    ways = (("mlp", trained.model, None), ("relaxation_aware", trained.grey.model, aware))
    bound_mT = np.sqrt(2.0 / np.pi) * NOISE_N / along.slope_N_mT[along.scored]
    return {
        "synthetic": True,
        "shape": SHAPE,
        **{
            name: along.scores(fields_of(solve_all(nearest(), model, along.features, along.force_N, memory)))
            for name, model, memory in ways
        },
        "noise_bound_mae_mT": float(bound_mT.mean()),
        "scored_share": float(along.scored.mean()),
    }


def hold(trained: Trained, duration_s: float) -> dict[str, float]:
    """Render pulses by feed-forward on a pad held at 4.5 mm, and return the greatest error, a share of the force."""
    dt_s = 1.0 / HOLD_RATE_HZ
    rising = round(FULL_INDENTATION_MM * HOLD_RATE_HZ)
    count = rising + round(duration_s * HOLD_RATE_HZ)
    time_s, rate_mm_s = np.arange(1.0, count + 1.0) * dt_s, np.where(np.arange(count) < rising, 1.0, 0.0)
    pressed = Program(time_s, np.minimum(time_s, FULL_INDENTATION_MM), rate_mm_s, np.zeros(count))
    beats_N = scaled(pulse_shape(HELD_PULSE_S, HOLD_RATE_HZ), *HOLD_FORCES_N)
    # forwards and backwards, so that the repetition has no jump
    asked_N = np.resize(np.concatenate((beats_N, beats_N[::-1])), count - rising)
    pad = PADS[PAD_IN_USE]
    features = pressed.features(pad.cip_percent)
    grey, worst = trained.grey, {}
    for name, model, memory in (("without", trained.model, None), ("with", grey.model, GreyBoxMemory(grey, dt_s))):
        if memory is not None:
            for row in features[:rising].tolist():
                memory.advance(*row)
        answers = solve_all(nearest(), model, features[rising:], asked_N, memory)
        fields_mT = np.concatenate((np.zeros(rising), fields_of(answers)))
        rendered_N = worked_pad(pad).run(*pressed._replace(field_mT=fields_mT))[rising:]
        worst[name] = float((np.abs(rendered_N - asked_N) / asked_N).max())
    return worst
