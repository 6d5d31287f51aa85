"""What duties and currents say of the carriages, by the laws of `tormagd.simulation.axis` in steady motion.

volts    V = R i + K w + L di/dt                             K = gear ratio times Ke, w the screw's speed
torque   K i = J w' + l N + sign(w) (c + r mu N + (1 - e) max(|K i| - c, 0))        N = pull(gap) + sign(w) drag
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from tormag_lab.arrays import Array, rms
from tormag_lab.errors import LabError
from tormag_lab.twin.estimate import Estimate, Prior, Values, estimated, named, value_at, with_values
from tormag_lab.twin.excerpt import GRID_HZ, IDLE_A, Excerpt, Moves
from tormagd.commission.carriage_findings import SIDES
from tormagd.simulation.parameters import PlantParameters
from tormagd.simulation.static_laws import pull_of_magnets_N

VOLTS, AMPS = 0.5, 0.3
"Error scales of both laws in the fit."
RIPPLE_MS = 0.02
"Relative error, for each ms of a tick, of a current that ripples within the tick and is told once."
SUPPLY_STEP_V = 0.1
"Resolution of the supply in a Status."


class Driven(NamedTuple):
    """The carriages' estimate, and how far unexplained speed moves the gap within their lag, RMS."""

    estimate: Estimate
    error_mm: float


MIN_MOVING = 200
"Four seconds of motion of a carriage."


def lag_s(plant: PlantParameters) -> float:
    """Return the time constant of a motor's speed after its voltage, without gearbox and screw."""
    motor = plant.motor
    return motor.inertia_kg_m2 * motor.resistance_Ohm / motor.back_emf_V_s_rad**2


def priors_of(plant: PlantParameters, supply_V: float, tick_ms: float) -> list[Prior]:
    """Return what is believed of carriages beforehand: the spread of the plant card's devices."""
    ripple = RIPPLE_MS * tick_ms
    shares = {
        "motor.resistance_Ohm": (0.15, 0.0),
        "motor.back_emf_V_s_rad": (0.08, 0.0),
        "motor.inductance_mH": (0.4, 0.1),
        "motor.inertia_kg_m2": (0.5, ripple),
        "gear.efficiency": (0.1, 3.0 * ripple),
        "gear.output_friction_Nm": (0.3, 3.0 * ripple),
        "screw.friction_coefficient": (0.25, 0.0),
        "screw.drag_left_N": (0.5, 0.0),
        "screw.drag_right_N": (0.5, 0.0),
    }
    keyed = ((key, value_at(plant, key), *sizes) for key, sizes in shares.items())
    return [
        *(Prior(key, value, share * value, 1e-12, floor * value) for key, value, share, floor in keyed),
        Prior("supply", 1.0, SUPPLY_STEP_V / math.sqrt(12.0) / supply_V),
        Prior("pull", 1.0, 0.25, 0.0),
        Prior("delay_s", 0.0, 2e-3),
    ]


def fit_carriages(prior: PlantParameters, ways: Sequence[Excerpt], only: Sequence[str] | None = None) -> Driven:
    tick_ms = 1e3 / GRID_HZ / float(np.median(ways[0].ticks))
    priors = [
        each
        for each in priors_of(prior, ways[0].supply_V, tick_ms)
        if only is None or each.key in only or "." not in each.key
    ]
    rows = {side: Moves(*np.concatenate([np.array(way.moves[side]) for way in ways], axis=1)) for side in SIDES}
    pulls = {side: np.asarray(pull_of_magnets_N(seen.gap_mm, prior), dtype=np.float64) for side, seen in rows.items()}
    if min(len(seen.block) for seen in rows.values()) < MIN_MOVING:
        raise LabError(
            f"{ways[0].name}: the carriages hardly moved by the daemon's duties: allowed is a force that changes"
        )

    def plant_of(values: Values) -> PlantParameters:
        return with_values(prior, {key: value for key, value in values.items() if "." in key})

    def off(values: Array) -> Array:
        told = named(priors, values)
        plant = plant_of(told)
        parts = []
        for side, seen in rows.items():
            parts.append(_volts_off(plant, seen, told) / VOLTS)
            parts.append(_amps_off(plant, seen, told["pull"] * pulls[side], side) / AMPS)
        return np.concatenate(parts)

    blocks = np.concatenate([block for seen in rows.values() for block in (seen.block, seen.block)])
    found = estimated(off, priors, blocks, 1.0, plant_of)
    plant, told = found.plant, named(priors, found.values)
    speeds = [
        _volts_off(plant, seen, told) / (plant.gear.ratio * plant.motor.back_emf_V_s_rad) for seen in rows.values()
    ]
    return Driven(found, rms(np.concatenate(speeds)) * plant.screw.lead_mm / math.tau * lag_s(plant))


def _volts_off(plant: PlantParameters, seen: Moves, told: Mapping[str, float]) -> Array:
    """Return by how much each row (n) misses the law of volts, V; positive where too much was applied."""
    motor, omega = plant.motor, _screw(plant, seen.speed_m_s)
    applied = told["supply"] * (seen.volts - told["delay_s"] * seen.volts_s)
    return (
        applied
        - motor.resistance_Ohm * seen.current_A
        - plant.gear.ratio * motor.back_emf_V_s_rad * omega
        - 1e-3 * motor.inductance_mH * seen.current_A_s
    )


def _amps_off(plant: PlantParameters, seen: Moves, pull_N: Array, side: str) -> Array:
    """Return by how much each row (n) misses the law of torque, A; positive where the current is too much."""
    gear, screw = plant.gear, plant.screw
    coupling = gear.ratio * plant.motor.back_emf_V_s_rad
    way = np.sign(seen.speed_m_s)
    load_N = pull_N + way * value_at(plant, f"screw.drag_{side}_N")
    drive = coupling * seen.current_A
    friction = (
        gear.output_friction_Nm
        + screw.friction_coefficient * 0.5e-3 * plant.assumed.screw_mean_diameter_mm * np.abs(load_N)
    )
    over_A = seen.over_A - seen.over_share * (gear.output_friction_Nm / coupling - IDLE_A)
    friction = friction + (1.0 - gear.efficiency) * coupling * over_A
    inertia = plant.motor.inertia_kg_m2 * gear.ratio**2
    load = screw.lead_mm * 1e-3 / math.tau * load_N
    return (drive - load - way * friction - inertia * _screw(plant, seen.acceleration_m_s2)) / coupling


def _screw(plant: PlantParameters, along_m: Array) -> Array:
    return along_m / (plant.screw.lead_mm * 1e-3 / math.tau)
