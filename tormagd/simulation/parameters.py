"""What a simulated device is made of: the plant file, typed, bounded and refused when it makes no sense."""

from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from tormagd.element.physics.force import Elastomer as ElastomerLaw
from tormagd.element.physics.friction import Friction as FrictionLaw
from tormagd.element.physics.inserts import insert
from tormagd.element.physics.relaxation import PronySeries
from tormagd.ground.files import named, shipped
from tormagd.ground.toml_file import convert, convert_as
from tormagd_client.endpoints import ConfigError
from tormagd_client.printable import require

PLANTS_INSERT = "MRE-50-40"
"The committed samples have it."
_PLANTS = resources.files(__package__) / "plants"

PlantError = ConfigError
"A plant file that cannot be used: the message names key, value and what is allowed."
Positive = Annotated[float, Meta(gt=0.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]
Share = Annotated[float, Meta(ge=0.0, lt=1.0)]


class Elastomer(Struct, frozen=True, forbid_unknown_fields=True):
    """The MRE insert, as in tables 2.3 and 2.4 of the thesis."""

    shear_modulus_kPa: Annotated[float, Meta(ge=1.0, le=10_000.0)]
    relative_permeability: Annotated[float, Meta(ge=1.0, le=10.0)]
    kinetic_friction: Annotated[float, Meta(gt=0.0, le=2.0)]

    @property
    def law(self) -> ElastomerLaw:
        return ElastomerLaw(self.shear_modulus_kPa * 1e3, self.relative_permeability, self.kinetic_friction)


class Friction(Struct, frozen=True, forbid_unknown_fields=True):
    static_to_kinetic: Annotated[float, Meta(ge=1.0, le=3.0)]
    stribeck_speed_mm_s: Positive
    presliding_stiffness_N_mm: Positive
    viscous_N_s_mm: NotNegative

    @property
    def law(self) -> FrictionLaw:
        return FrictionLaw(
            presliding_stiffness_N_mm=self.presliding_stiffness_N_mm,
            viscous_N_s_mm=self.viscous_N_s_mm,
            static_ratio=self.static_to_kinetic,
            stribeck_speed_mm_s=self.stribeck_speed_mm_s,
        )


class Field(Struct, frozen=True, forbid_unknown_fields=True):
    """Radial moment of the magnets over their gap; hysteresis is a share of its value at 45 mm."""

    law: Literal["power", "thesis"]
    coefficient: Annotated[float, Meta(gt=0.0, le=10.0)]
    exponent: Annotated[float, Meta(ge=-3.0, lt=0.0)]
    hysteresis_percent: Annotated[float, Meta(ge=0.0, le=10.0)]


class Relaxation(Struct, frozen=True, forbid_unknown_fields=True):
    """Prony terms: each share of a force step dies away with its time constant."""

    fractions: Annotated[tuple[Share, ...], Meta(min_length=1, max_length=8)]
    times_s: Annotated[tuple[Positive, ...], Meta(min_length=1, max_length=8)]

    def __post_init__(self) -> None:
        require(
            len(self.fractions) == len(self.times_s),
            "fractions",
            self.fractions,
            f"one for each of {self.times_s}",
        )
        require(sum(self.fractions) < 1.0, "fractions", self.fractions, "a sum under 1")

    @property
    def law(self) -> PronySeries:
        return PronySeries(self.fractions, self.times_s)


class PadParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """A tactile pad in the place of insert and shaft: see `TactilePad`. Moduli are those of the worked pad at small
    strain.
    """

    cip_percent: Annotated[float, Meta(ge=0.0, le=60.0)]
    modulus_kPa: Annotated[float, Meta(ge=1.0, le=10_000.0)]
    full_field_modulus_kPa: Annotated[float, Meta(ge=1.0, le=10_000.0)]
    breakdown: Annotated[float, Meta(ge=0.0, le=1.0)]
    "Share of the field's stiffening that strain destroys."
    diameter_mm: Annotated[float, Meta(ge=1.0, le=100.0)] = 30.0
    height_mm: Annotated[float, Meta(ge=10.0, le=100.0)] = 12.5
    breakdown_strain: Positive = 0.15
    gent_limit: Annotated[float, Meta(ge=3.0, le=100.0)] = 3.5
    saturation_mT: Positive = 260.0
    rate_gain: Annotated[float, Meta(ge=0.0, le=0.1)] = 0.018
    field_rate_gain: Annotated[float, Meta(ge=0.0, le=0.1)] = 0.026
    rate_scale_mm_s: Positive = 0.8
    mullins_share: Share = 0.15
    mullins_travel_mm: Positive = 20.0
    relaxing: Relaxation = Relaxation((0.015, 0.040, 0.028, 0.025), (1.2, 9.5, 95.0, 1100.0))
    field_relaxing: Relaxation = Relaxation((0.018, 0.048, 0.034, 0.030), (0.8, 6.5, 70.0, 800.0))


class SecondParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """The element of the second plant: see `SecondElement`."""

    concentration: Annotated[float, Meta(ge=1.0, le=3.0)]
    without_field_N: NotNegative
    saturated_N: Annotated[float, Meta(gt=0.0, le=100.0)]
    saturating_mT: Positive
    play_mT: Annotated[tuple[NotNegative, ...], Meta(min_length=1, max_length=8)]
    play_shares: Annotated[tuple[Share, ...], Meta(min_length=1, max_length=8)]
    creeping_share: Share
    creep_scale_N: Annotated[float, Meta(ge=1e-3, le=10.0)]
    creep_s: Annotated[float, Meta(ge=1.0)]
    reference_mm_s: Positive
    slow_mm_s: Annotated[float, Meta(ge=0.01)]
    rate_gain: Annotated[float, Meta(ge=0.0, le=0.05)]
    age_gain: Annotated[float, Meta(ge=0.0, le=0.1)]
    ageing_s: Positive
    renewed_mm: Positive
    springs_N_mm: Annotated[tuple[Positive, ...], Meta(min_length=1, max_length=8)]
    spring_shares: Annotated[tuple[Share, ...], Meta(min_length=1, max_length=8)]

    def __post_init__(self) -> None:
        for one, other in (("play_shares", "play_mT"), ("spring_shares", "springs_N_mm")):
            shares, paired = getattr(self, one), getattr(self, other)
            require(len(shares) == len(paired), one, shares, f"one for each of {paired}")
        require(sum(self.play_shares) < 1.0, "play_shares", self.play_shares, "a sum under 1")
        require(abs(sum(self.spring_shares) - 1.0) < 1e-9, "spring_shares", self.spring_shares, "a sum of 1")


class Thermal(Struct, frozen=True, forbid_unknown_fields=True):
    """How temperature affects the force, and how fast the insert begins to warm."""

    force_percent_K: Annotated[float, Meta(ge=-5.0, le=5.0)]
    drift_K_h: Annotated[float, Meta(ge=0.0, le=20.0)]


class Magnets(Struct, frozen=True, forbid_unknown_fields=True):
    """Two equal blocks; the last size is along the magnetisation."""

    size_mm: tuple[Positive, Positive, Positive]
    remanence_T: Annotated[float, Meta(gt=0.0, le=1.6)]


class Motor(Struct, frozen=True, forbid_unknown_fields=True):
    """One brushed motor, as seen on the motor's own shaft."""

    resistance_Ohm: Positive
    back_emf_V_s_rad: Positive
    inductance_mH: Positive
    inertia_kg_m2: Positive


class Gear(Struct, frozen=True, forbid_unknown_fields=True):
    """The mesh loses 1 - `efficiency` of the torque above `output_friction_Nm`, which the no-load current shows."""

    ratio: Annotated[float, Meta(ge=1.0)]
    efficiency: Annotated[float, Meta(gt=0.0, le=1.0)]
    output_friction_Nm: NotNegative


class Screw(Struct, frozen=True, forbid_unknown_fields=True):
    lead_mm: Annotated[float, Meta(gt=0.0, le=50.0)]
    friction_coefficient: Annotated[float, Meta(ge=0.0, le=1.0)]
    drag_left_N: NotNegative
    drag_right_N: NotNegative
    backlash_um: Annotated[float, Meta(ge=0.0, le=1000.0)]
    stiffness_N_um: Positive


class Electronics(Struct, frozen=True, forbid_unknown_fields=True):
    """Encoder counts are per turn of the gearbox output."""

    encoder_counts_per_rev: Annotated[int, Meta(ge=16, le=1_000_000)]
    supply_V: Annotated[float, Meta(gt=0.0, le=25.0)]
    current_limit_A: Annotated[float, Meta(gt=0.0, le=30.0)]
    pwm_bits: Annotated[int, Meta(ge=4, le=16)]


class ForceSensor(Struct, frozen=True, forbid_unknown_fields=True):
    """The noise is one sample's standard deviation. The offset drifts steadily, up or down by the seed."""

    noise_mN: Annotated[float, Meta(ge=0.0, le=1000.0)]
    drift_mN_min: Annotated[float, Meta(ge=0.0, le=1000.0)]
    delay_ms: Annotated[float, Meta(ge=0.0, le=1000.0)]
    rate_Hz: Annotated[float, Meta(gt=0.0, le=1000.0)]


class FirmwareTiming(Struct, frozen=True, forbid_unknown_fields=True):
    """How far the device's clock is off the host's, and the width of the random delay before a reply."""

    clock_ppm: Annotated[float, Meta(ge=-1000.0, le=1000.0)]
    reply_jitter_us: Annotated[float, Meta(ge=0.0, le=5000.0)]


class Assumed(Struct, frozen=True, forbid_unknown_fields=True):
    """What the plant card leaves open. Every default is an assumption, with its reason beside it."""

    screw_mean_diameter_mm: Positive = 7.0  # an 8 mm trapezoidal screw, thread depth 1 mm
    ambient_C: Annotated[float, Meta(ge=-20.0, le=60.0)] = 25.0  # where the thesis's temperature range begins
    warm_C: Annotated[float, Meta(ge=-20.0, le=100.0)] = 40.0  # where it ends: warming levels off there
    handle_counts_per_rev: Annotated[int, Meta(ge=16, le=65536)] = 16384  # 14-bit magnetic shaft encoder
    home_mm: Positive = 47.5  # open switch: half of the largest gap, 95 mm
    closed_mm: Positive = 22.25  # closed switch: a quarter millimetre inside half of the smallest gap, 45 mm
    stop_beyond_mm: Positive = 0.25  # hard stop behind the closed switch; twice that behind the open one
    start_left_mm: Positive = 40.0  # where the carriages are at power-on: somewhere, and not equal
    start_right_mm: Positive = 39.0
    attraction_factor: Annotated[float, Meta(ge=0.5, le=5.0)] = 2.0  # iron shaft: 30 N at 45 mm in air, card 50..80 N
    hysteresis_scale: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.1  # field change, of the largest, that turns a branch
    retract_mm_s: Annotated[float, Meta(gt=0.0, le=100.0)] = 15.0  # a carriage's; 80% of what 12 V reach under load
    homing_mm_s: Annotated[float, Meta(gt=0.0, le=100.0)] = 8.0  # stops by braking within 0.15 mm of the switch
    overcurrent_A: Positive = 3.0  # well over the 1 A of the worst travel, under the 3.7 A of the weakest stall
    force_range_N: Annotated[float, Meta(gt=0.0, le=32.0)] = 20.0  # where the force sensor saturates

    def __post_init__(self) -> None:
        least_mm, most_mm = self.closed_mm, self.home_mm
        require(
            self.stop_beyond_mm < least_mm < most_mm,
            "assumed.closed_mm",
            least_mm,
            f"over stop_beyond_mm = {self.stop_beyond_mm} and under home_mm = {most_mm}",
        )
        for key in ("start_left_mm", "start_right_mm"):
            start_mm, between = getattr(self, key), f"between the switches, {least_mm} .. {most_mm}"
            require(least_mm < start_mm < most_mm, f"assumed.{key}", start_mm, between)
        require(self.warm_C >= self.ambient_C, "assumed.warm_C", self.warm_C, f"at least ambient_C = {self.ambient_C}")


class PlantParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """One simulated device, in the units of the plant card."""

    elastomer: Elastomer
    friction: Friction
    field: Field
    relaxation: Relaxation
    thermal: Thermal
    magnets: Magnets
    motor: Motor
    gear: Gear
    screw: Screw
    electronics: Electronics
    force_sensor: ForceSensor
    firmware: FirmwareTiming
    assumed: Assumed = Assumed()
    pad: PadParameters | None = None
    "In the place of insert and shaft, whose tables are then unused."
    second: SecondParameters | None = None
    "In the place of the insert, whose tables and `field` are then unused."

    def __post_init__(self) -> None:
        limit_A = self.electronics.current_limit_A
        require(
            self.assumed.overcurrent_A < limit_A,
            "assumed.overcurrent_A",
            self.assumed.overcurrent_A,
            f"under electronics.current_limit_A = {limit_A}",
        )

    @property
    def closed_stop_mm(self) -> float:
        return self.assumed.closed_mm - self.assumed.stop_beyond_mm

    @property
    def open_stop_mm(self) -> float:
        return self.assumed.home_mm + 2.0 * self.assumed.stop_beyond_mm


class _Between(Struct, frozen=True, forbid_unknown_fields=True):
    """A plant file with another element. `carriages` names the plant with all the other parts."""

    carriages: str
    pad: PadParameters | None = None
    second: SecondParameters | None = None

    def __post_init__(self) -> None:
        require(
            (self.pad is None) != (self.second is None),
            "carriages",
            self.carriages,
            "a plant with one of [pad] and [second] between its magnets",
        )


def _kind(tables: dict[str, Any]) -> type[PlantParameters | _Between]:
    return _Between if "carriages" in tables else PlantParameters


def plant_names() -> tuple[str, ...]:
    return shipped(_PLANTS, ".toml")


def load_plant(path_or_name: str | Path) -> PlantParameters:
    """Read a packaged plant by its name, such as `sample_1`, or a TOML file. Raises PlantError."""
    path = named("plant", str(path_or_name), _PLANTS, ".toml")
    read = convert_as(path, _kind)
    if isinstance(read, PlantParameters):
        return read
    carried = convert(named("carriages", read.carriages, _PLANTS, ".toml"), PlantParameters)
    return msgspec.structs.replace(carried, pad=read.pad, second=read.second)


def changed(plant: PlantParameters, table: str, **values: object) -> PlantParameters:
    """Return the plant with other values in one of its tables."""
    return msgspec.structs.replace(plant, **{table: msgspec.structs.replace(getattr(plant, table), **values)})


def standing(plant: PlantParameters, left_mm: float, right_mm: float) -> PlantParameters:
    """Return the plant whose carriages are there at power-on."""
    return changed(plant, "assumed", start_left_mm=left_mm, start_right_mm=right_mm)


def with_insert(plant: PlantParameters, name: str) -> PlantParameters:
    """Return the plant with another insert."""
    nominal, other = insert(PLANTS_INSERT).elastomer, insert(name).elastomer
    own = plant.elastomer
    fitted = Elastomer(
        own.shear_modulus_kPa * other.shear_modulus_Pa / nominal.shear_modulus_Pa,
        max(own.relative_permeability * other.relative_permeability / nominal.relative_permeability, 1.0),
        own.kinetic_friction * other.friction_coefficient / nominal.friction_coefficient,
    )
    return plant if name == PLANTS_INSERT else msgspec.structs.replace(plant, elastomer=fitted)
