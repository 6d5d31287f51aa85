"""The pulse experiment of section 4.3 on the synthetic pad, and pulses rendered on a pad held for an hour."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tormag_lab.arrays import Array, Mask
from tormag_lab.human_pulse import pulse_profile, recorded, scaled
from tormag_lab.tactile.models import PAD_IN_USE, SCORED_SLOPE_N_MT, Effort, Trained, plant_force_N, slope_N_per_mT
from tormag_lab.tactile.pads import PADS, Program, drawn_pad
from tormag_lab.training.grey_box import GreyBoxMemory
from tormagd.element.inverse.nearest import NearestFieldSearch, field_grid
from tormagd.element.inverse.ordered import RowByRow
from tormagd.element.inverse.solution import FieldSolution, FieldSolver, Reach
from tormagd.element.model.model_file import ForceModel
from tormagd.simulation.parameters import PadParameters
from tormagd.simulation.tactile_pad import FULL_FIELD_MT, FULL_INDENTATION_MM, worked_pad

SAMPLES = 4322
RATE_HZ = 160
"Gives as many samples as the thesis has, from the 25 s of measured pulse."
REFERENCE_FIELDS_MT = (100.0, 200.0)
FIELDS_MT = (0.0, FULL_FIELD_MT)
THESIS_EPSILON_N = 1.26
"The thesis's neighbourhood: the mean error of its network."
OTHER_PADS = (1, 2)
SENSOR_SEED = 7
SHAPE = "measured photoplethysmogram (heartpy)"

HOLD_RATE_HZ = 10
HOLD_FORCES_N = (148.0, 154.0)
"Forces that the field reaches both at first and after an hour of relaxation."
HELD_PULSE_S = 20.0
TEN_MINUTES_S = 600.0


def pulse_shape(duration_s: float, rate_hz: int) -> Array:
    """Return a measured pulse (n) between 0 and 1."""
    return pulse_profile(duration_s, 0.0, 1.0, rate_hz)[1]


def recorded_shapes(duration_s: float, rate_hz: int) -> dict[str, Array]:
    """Return measured arterial pulses (n) between 0 and 1 by file name, repeated to `duration_s`."""
    shapes = {}
    for path in recorded("aac_nibp_pulse"):
        time_s, pressure = np.loadtxt(path, delimiter=",", skiprows=1, unpack=True)
        # six beats that end as they began
        looped = np.interp(np.arange(round(duration_s * rate_hz)) / rate_hz, time_s, pressure, period=time_s[-1])
        shapes[path.stem] = scaled(looped, 0.0, 1.0)
    return shapes


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
    time_s: Array
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
    return Course(
        pad, done.time_s[::every], features, force_N[::every], slope_N_per_mT(pad, features[:, :3]), every / RATE_HZ
    )


def nearest() -> NearestFieldSearch:
    return NearestFieldSearch(field_grid(FIELDS_MT, 2.0))


def aware_fields(trained: Trained, along: Course, noise_N: float = 0.0) -> Array:
    noisy_N = along.force_N + np.random.default_rng(SENSOR_SEED).normal(0.0, noise_N, len(along.force_N))
    memory = GreyBoxMemory(trained.grey, along.dt_s)
    return fields_of(solve_all(nearest(), trained.grey.model, along.features, noisy_N, memory))


def pulse_on(along: Course, trained: Trained) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return scores and traces (n each) of each way from force to field, by name."""
    linear = RowByRow(field_grid(FIELDS_MT, 1.0), THESIS_EPSILON_N, lambda curve, field_mT: curve.force_N(field_mT))
    ways = {
        "mlp": fields_of(solve_all(nearest(), trained.model, along.features, along.force_N, None)),
        "mlp_thesis_search": fields_of(solve_all(linear, trained.model, along.features, along.force_N, None)),
        "relaxation_aware": aware_fields(trained, along),
        "relaxation_aware_noisy": aware_fields(trained, along, trained.noise_N),
    }
    bound_mT = np.sqrt(2.0 / np.pi) * trained.noise_N / along.slope_N_mT[along.scored]
    scores: dict[str, Any] = {name: along.scores(fields) for name, fields in ways.items()}
    scores["noise_bound_mae_mT"] = float(bound_mT.mean())
    scores["scored_share"] = float(along.scored.mean())
    traces = {"time_s": along.time_s, "displacement_mm": along.features[:, 0], "force_N": along.force_N}
    return scores, traces | {"reference": along.features[:, 2], "slope_N_mT": along.slope_N_mT} | ways


def pulse(trainings: Sequence[Trained], effort: Effort) -> tuple[dict[str, Any], dict[str, Array]]:
    shape = pulse_shape(HELD_S, RATE_HZ)
    pad, every = PADS[PAD_IN_USE], effort.pulse_every
    own = course(pad, shape, every)
    strangers = [course(drawn_pad(pad, seed), shape, every) for seed in OTHER_PADS]
    arterial = {name: course(pad, other, every) for name, other in recorded_shapes(HELD_S, RATE_HZ).items()}
    rendered = [pulse_on(own, trained) for trained in trainings]
    for trained, (scores, _) in zip(trainings, rendered, strict=True):
        scores["other_pads"] = [along.scores(aware_fields(trained, along)) for along in strangers]
        scores["other_pulses"] = {name: along.scores(aware_fields(trained, along)) for name, along in arterial.items()}
    top, traces = rendered[0]
    kept = ("mlp", "mlp_thesis_search", "relaxation_aware", "noise_bound_mae_mT", "scored_share")
    by_noise = {str(trained.noise_N): scores for trained, (scores, _) in zip(trainings, rendered, strict=True)}
    return {"synthetic": True, "shape": SHAPE, **{name: top[name] for name in kept}, "by_noise": by_noise}, traces


def hold(trained: Trained, duration_s: float) -> dict[str, Any]:
    """Render pulses by feed-forward on a pad held at 4.5 mm, and return the errors."""
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
    grey, scores = trained.grey, {}
    for name, model, memory in (("without", trained.model, None), ("with", grey.model, GreyBoxMemory(grey, dt_s))):
        if memory is not None:
            for row in features[:rising].tolist():
                memory.advance(*row)
        answers = solve_all(nearest(), model, features[rising:], asked_N, memory)
        fields_mT = np.concatenate((np.zeros(rising), fields_of(answers)))
        rendered_N = worked_pad(pad).run(*pressed._replace(field_mT=fields_mT))[rising:]
        error = np.abs(rendered_N - asked_N) / asked_N
        scores[name] = {
            "force_error_10min": float(error[: round(TEN_MINUTES_S * HOLD_RATE_HZ)].max()),
            "force_error_1h": float(error.max()),
            "mean_force_error": float(error.mean()),
            "out_of_reach_share": sum(answer.reach is not Reach.INSIDE for answer in answers) / len(answers),
        }
    return {"duration_s": duration_s, **scores}
