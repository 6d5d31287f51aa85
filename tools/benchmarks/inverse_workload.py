"""The workload of `benchmark inverse`: a plant, networks trained on it, a course of forces, the networks' own roots.

The plant is the simulator's torque element without memory: its force law, field law, pre-sliding and Stribeck friction.
Hysteresis and relaxation are left out, because no search could undo them and they would hide the searches.
"""

import datetime
from typing import NamedTuple

import numpy as np

from tormagd.control.nominal import FieldOfGap
from tormagd.element.model.features import Element
from tormagd.element.model.model_file import ForceModel
from tormagd.element.physics.field import PowerFieldLaw
from tormagd.element.physics.force import TORMAG, Elastomer, brake_force_N
from tormagd.element.physics.friction import Friction
from tormagd.element.physics.inserts import insert
from tormagd.lab.arrays import Array
from tormagd.lab.training.dataset import Dataset
from tormagd.lab.training.fitting import fit_model
from tormagd.simulation.parameters import PlantParameters
from tormagd.simulation.static_laws import radial_moment_Tm

INSERT = insert("MRE-50-40")
CIP_PERCENT = 100.0 * INSERT.cip_fraction
GAPS_MM = (45.0, 95.0)
NOMINAL = FieldOfGap(PowerFieldLaw(), INSERT.elastomer.relative_permeability, TORMAG.inner_radius_m)
FIELDS_MT = (NOMINAL.field_mT(GAPS_MM[1]), NOMINAL.field_mT(GAPS_MM[0]))
"What the controller calls field: the nominal law's, over the device's stroke."

DISPLACEMENTS_MM = (1.4, 2.1)
RATES_MM_S = (2.0, 55.0)
"Near full mobilisation and in motion: before break-away the hand chooses the force, and the inverse is ill-posed."

COVERED = (0.04, 0.96)
ROOT_STEP_MT = 0.5


class Course(NamedTuple):
    displacement_mm: Array
    rate_mm_s: Array
    field_mT: Array
    force_N: Array

    def rows(self) -> list[tuple[float, float, float]]:
        return list(zip(self.displacement_mm.tolist(), self.rate_mm_s.tolist(), self.force_N.tolist(), strict=True))


def plant_force_N(plant: PlantParameters, displacement_mm: Array, rate_mm_s: Array, field_mT: Array) -> Array:
    """Return the plant's force so far after a reversal at a steady rate, at the gap with nominal field `field_mT`."""
    gaps = np.array([min(max(NOMINAL.gap_mm(field), GAPS_MM[0]), GAPS_MM[1]) for field in field_mT.tolist()])
    elastomer = Elastomer(
        shear_modulus_Pa=plant.elastomer.shear_modulus_kPa * 1e3,
        relative_permeability=plant.elastomer.relative_permeability,
        friction_coefficient=plant.elastomer.kinetic_friction,
    )
    kinetic_N = brake_force_N(radial_moment_Tm(gaps, plant), elastomer, TORMAG)
    friction = Friction(
        presliding_stiffness_N_mm=plant.friction.presliding_stiffness_N_mm,
        viscous_N_s_mm=plant.friction.viscous_N_s_mm,
        static_ratio=plant.friction.static_to_kinetic,
        stribeck_speed_mm_s=plant.friction.stribeck_speed_mm_s,
    )
    # a reversal leaves the bristles bent the other way, which is the largest deflection there is
    columns = zip(displacement_mm.tolist(), rate_mm_s.tolist(), kinetic_N.tolist(), strict=True)
    return np.array([friction.advance(-1e3, rate, level, travel / rate)[0] for travel, rate, level in columns])


def course(plant: PlantParameters, solves: int) -> Course:
    """Return a smooth course through the plant's range: slow and fast swings of field, speed and travel."""
    phase = 2 * np.pi * np.arange(solves) / solves
    middle, swing = sum(COVERED) / 2, (COVERED[1] - COVERED[0]) / 2
    share = middle + swing * (0.8 * np.sin(3 * phase) + 0.2 * np.sin(17 * phase))
    field = FIELDS_MT[0] + share * (FIELDS_MT[1] - FIELDS_MT[0])
    rate = 25.0 + 20.0 * np.sin(5 * phase)
    displacement = 1.75 + 0.25 * np.sin(7 * phase)
    return Course(displacement, rate, field, plant_force_N(plant, displacement, rate, field))


def training_data(plant: PlantParameters, rows: int, seed: int) -> Dataset:
    draw = np.random.default_rng(seed)
    displacement, rate = draw.uniform(*DISPLACEMENTS_MM, rows), draw.uniform(*RATES_MM_S, rows)
    field = draw.uniform(*FIELDS_MT, rows)
    force = plant_force_N(plant, displacement, rate, field)
    force = force + draw.normal(0.0, 1e-3 * plant.force_sensor.noise_mN, rows)
    return Dataset(np.column_stack((displacement, rate, field, np.full(rows, CIP_PERCENT))), force)


def trained(data: Dataset, hidden: int, epochs: int) -> ForceModel:
    model, _ = fit_model(
        *data.split(0.3, 0),
        element=Element.TORQUE,
        inserts=(INSERT.name,),
        data_sha256=data.sha256(),
        created=datetime.date(2024, 1, 1),
        hidden=hidden,
        epochs=epochs,
    )
    return model


def network_roots_mT(model: ForceModel, along: Course) -> list[Array]:
    """Return for each solve every field in range at which the network gives the force."""
    grid = np.linspace(*FIELDS_MT, int((FIELDS_MT[1] - FIELDS_MT[0]) / ROOT_STEP_MT) + 2)
    found: list[Array] = []
    for displacement, rate, force in along.rows():
        excess = _network(model, displacement, rate, grid) - force
        left = np.flatnonzero((excess[1:] < 0) != (excess[:-1] < 0))
        low, high, rises = grid[left], grid[left + 1], excess[left] < 0
        for _ in range(40 if left.size else 0):
            middle = (low + high) / 2
            under = (_network(model, displacement, rate, middle) < force) == rises
            low, high = np.where(under, middle, low), np.where(under, high, middle)
        found.append((low + high) / 2)
    return found


def _network(model: ForceModel, displacement_mm: float, rate_mm_s: float, fields_mT: Array) -> Array:
    of_all = [np.full(len(fields_mT), value) for value in (displacement_mm, rate_mm_s, CIP_PERCENT)]
    return model.predict(np.column_stack((*of_all[:2], fields_mT, of_all[2])))
