"""The samples, and random devices around sample 1: seeded, so that a draw is the same every time."""

import msgspec
import numpy as np

from tormagd.simulation.parameters import PlantParameters, load_plant

SAMPLES = ("sample_1", "sample_2", "sample_3")
SECOND = "second"
FIRST_DRAW = 40
"The first draw of the plant card that only judges: constants were chosen on earlier ones."
TURNING_GAP_MM = 67.0
"The field is drawn at this gap; the drawn exponent turns the law about it."
SEED = 2026


def device(name: str) -> PlantParameters:
    """Return a shipped plant by its name, or `draw N` of the plant card."""
    return drawn_device(int(name.split()[1])) if name.startswith("draw") else load_plant(name)


def judging(draws: int) -> list[str]:
    return [*SAMPLES, SECOND, *(f"draw {number}" for number in range(FIRST_DRAW, FIRST_DRAW + draws))]


def drawn_device(number: int) -> PlantParameters:
    random = np.random.default_rng((SEED, number))
    nominal = load_plant("sample_1")

    def factor(spread: float) -> float:
        return float(random.uniform(1.0 - spread, 1.0 + spread))

    elastomer = msgspec.structs.replace(
        nominal.elastomer,
        kinetic_friction=nominal.elastomer.kinetic_friction * factor(0.12),
        shear_modulus_kPa=nominal.elastomer.shear_modulus_kPa * factor(0.12),
    )
    scale, exponent = factor(0.12), float(random.uniform(-1.34, -1.26))
    field = nominal.field
    coefficient = field.coefficient * scale * TURNING_GAP_MM ** (field.exponent - exponent)
    field = msgspec.structs.replace(field, coefficient=coefficient, exponent=exponent)
    if number % 3 == 2:
        # Eq. 7 takes no factor in a plant file: it goes into the permeability, with which the force grows as with b^2
        field = msgspec.structs.replace(nominal.field, law="thesis")
        permeability = nominal.elastomer.relative_permeability * scale**2
        elastomer = msgspec.structs.replace(elastomer, relative_permeability=permeability)
    relaxing = float(random.uniform(0.8, 1.6))
    motor = msgspec.structs.replace(
        nominal.motor,
        resistance_Ohm=nominal.motor.resistance_Ohm * factor(0.15),
        back_emf_V_s_rad=nominal.motor.back_emf_V_s_rad * factor(0.08),
        inertia_kg_m2=nominal.motor.inertia_kg_m2 * float(random.uniform(0.7, 1.7)),
    )
    return msgspec.structs.replace(
        nominal,
        elastomer=elastomer,
        field=field,
        relaxation=msgspec.structs.replace(
            nominal.relaxation, fractions=tuple(relaxing * part for part in nominal.relaxation.fractions)
        ),
        friction=msgspec.structs.replace(nominal.friction, static_to_kinetic=float(random.uniform(1.08, 1.25))),
        motor=motor,
        screw=msgspec.structs.replace(nominal.screw, backlash_um=float(random.uniform(30.0, 80.0))),
        force_sensor=msgspec.structs.replace(nominal.force_sensor, drift_mN_min=float(random.uniform(0.0, 5.0))),
    )
