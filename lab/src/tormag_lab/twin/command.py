"""Fit a plant file to recordings of one device: the simulator's laws, by regression, without simulating.

tormag-lab twin FILE.mcap ... --out mine.toml

Ordinary use will do: ten minutes with steps, pulses and holds, the handle going both ways. A number is told where its
interval (95 %) is at most half as wide as what is believed of any device. The others keep the prior's values, and the
motion that would tell them is named. Magnets, insert and the sensor's gain share the strength: only a weight parts them
(tormagctl commission --weight-N). A sensor that stands still is cut out, one that drifts is refused. What the laws do
not explain is the model error. Exit code 1 means that it is too large for the plant to stand for this device.
"""

import argparse
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from tormag_lab.arrays import rms
from tormag_lab.errors import LabError
from tormag_lab.main import Found
from tormag_lab.twin.carriages import SUPPLY_STEP_V, fit_carriages, lag_s
from tormag_lab.twin.estimate import TOLD, Estimate, keys_of, value_at, with_values
from tormag_lab.twin.excerpt import EVERY_TICK, GRID_HZ, Excerpt, excerpt_of
from tormag_lab.twin.force import DRIFT_MN_MIN, EXPONENT, PIVOT_MM, STRENGTH, Fitted, fit_force, strength_N
from tormagd.ground.files import new_file
from tormagd.simulation.parameters import Assumed, PlantParameters, load_plant

BELIEVED = 0.4
"No device of the plant card is further from sample 1's strength."


SLIDE = "slide the handle both ways at over 20 mm/s for a minute, at several forces"
STEPS = "step from the least force to the most and back, ten times"
HOLD = "hold the most force for a minute and the least for a minute, five times, the handle turning"
SLOWLY = "turn the handle to and fro from a stop up to 40 mm/s, ten times"
DATASHEET = "no motion tells it: take it from its data sheet"
MOTIONS: Mapping[str, str] = {
    "elastomer.kinetic_friction": SLIDE,
    "elastomer.shear_modulus_kPa": "no motion tells it from the field's exponent: press a sample of the insert",
    "elastomer.relative_permeability": "no motion tells it from the strength: magnetise a sample of the insert",
    "field.coefficient": "no motion tells it from the strength: measure the field at a gap of 67 mm",
    "field.exponent": STEPS,
    "field.hysteresis_percent": STEPS,
    "relaxation": HOLD,
    "friction": SLOWLY,
    "thermal": "record a device that warms by 5 K",
    "motor": "step from the least force to the most and back, ten times, without pauses",
    "gear.efficiency": "log the motor alone: tormagctl calibrate --motors and tormag-lab identify-motor",
    "gear.output_friction_Nm": "step from the least force to the most and back, ten times, without pauses",
    "screw.friction_coefficient": "no motion tells it from the gearbox: turn the screw by hand with a scale",
    "screw.drag_left_N": "no motion tells it from the gearbox: push the carriage with a scale, nut off",
    "screw.drag_right_N": "no motion tells it from the gearbox: push the carriage with a scale, nut off",
    "screw.backlash_um": "no motion tells it: the encoder is on the motor's side of the play; use a dial gauge",
    "screw.stiffness_N_um": "no motion tells it: use a dial gauge and a weight",
    "force_sensor.rate_Hz": "it is as fast as the control ticks: take it from its data sheet",
    "force_sensor.drift_mN_min": "record ten minutes, the handle going both ways",
    "force_sensor.delay_ms": "turn the handle round within 0.1 s, ten times",
}
"What would tell a key, or the keys of a table."

CHOICE = (STRENGTH, EXPONENT, "field.hysteresis_percent", "friction.static_to_kinetic")
CHOICE_S = 120.0
"Enough to tell the field laws apart."
SLOW_MM_S = 2.0
NEAR_MM, FAR_MM = 60.0, 85.0
EXPLAINED_N, EXPLAINED_MM = 0.015, 0.05
"Above these the laws are not this device's."
CLOCK_PPM = 0.7
RATE_SHARE = 0.05
NOISE_SHARE = 0.02
"How far the noise of a sensor with steps of its own may be off."


class Told(NamedTuple):
    """A number and half the width of its 95 % interval; NaN where it is not told."""

    value: float
    half_width: float


class Twin(NamedTuple):
    """A plant, what is told of its keys and of COMBINATIONS, and the unexplained RMS."""

    plant: PlantParameters
    keys: dict[str, Told]
    combinations: dict[str, Told]
    force: Fitted
    noise_N: float
    gap_error_mm: float

    @property
    def is_explained(self) -> bool:
        return self.force.error_N <= EXPLAINED_N and self.gap_error_mm <= EXPLAINED_MM


def slope(plant: PlantParameters) -> float:
    return strength_N(plant, NEAR_MM) / strength_N(plant, FAR_MM)


def low_speed_factor(plant: PlantParameters) -> float:
    return plant.friction.law.level_N(SLOW_MM_S, 1.0)


OF_FORCE: dict[str, Callable[[PlantParameters], float]] = {
    f"force at {PIVOT_MM:g} mm, N": strength_N,
    f"force at {NEAR_MM:g} mm over that at {FAR_MM:g} mm": slope,
    f"friction at {SLOW_MM_S:g} mm/s over that at speed": low_speed_factor,
}
OF_CARRIAGES: dict[str, Callable[[PlantParameters], float]] = {"lag of the carriages, s": lag_s}
COMBINATIONS = OF_FORCE | OF_CARRIAGES
"Figures that several keys share, and that the data tell better than each key."
STANDS_FOR = {STRENGTH: strength_N, EXPONENT: slope}
"Keys that take on what the data tell of a combination, on behalf of its other keys."


def twin_of(prior: PlantParameters, ways: Sequence[Excerpt]) -> Twin:
    if prior.pad is not None or prior.second is not None:
        raise LabError("--prior: allowed is a plant with an insert, without [pad] and [second]")
    under = [
        msgspec.structs.replace(prior, field=msgspec.structs.replace(prior.field, law=law))
        for law in ("power", "thesis")
    ]
    early = [ways[0].first(CHOICE_S)]
    base = min(under, key=lambda each: rms(fit_force(each, early, CHOICE).estimate.residual))
    open_force, open_driven = fit_force(base, ways).estimate, fit_carriages(base, ways).estimate
    told = _told(open_force) | _told(open_driven)
    # keys that are not told stay the prior's, and the others move to where they then fit best
    force, driven = fit_force(base, ways, tuple(told)), fit_carriages(base, ways, tuple(told))
    plant = with_values(force.estimate.plant, {key: value_at(driven.estimate.plant, key) for key in _told(open_driven)})
    keys, combinations = {}, {}
    for estimate, functions in ((open_force, OF_FORCE), (open_driven, OF_CARRIAGES)):
        for key in (each.key for each in estimate.priors if each.key in told):
            value = value_at(plant, key)
            keys[key] = Told(value, math.hypot(told[key], value - value_at(estimate.plant, key)))
        for name, function in functions.items():
            value = function(plant)
            combinations[name] = Told(
                value, math.hypot(estimate.half_width(function), value - function(estimate.plant))
            )
    sensor = _of_sensor(ways, force)
    plant = with_values(plant, {key: each.value for key, each in sensor.items()})
    return Twin(plant, keys | sensor, combinations, force, _noise_N(ways)[0], driven.error_mm)


def _told(estimate: Estimate) -> dict[str, float]:
    """Return half the interval of each key of the plant file that the data tell."""
    found, plant = {}, estimate.plant
    for key in (each.key for each in estimate.priors if "." in each.key):
        function = STANDS_FOR.get(key, lambda plant, key=key: value_at(plant, key))
        value, step = value_at(plant, key), 1e-3 * abs(value_at(plant, key)) + 1e-9
        rise = function(with_values(plant, {key: value + step})) - function(plant)
        if not math.isnan(width := estimate.half_width(function)):
            found[key] = width * abs(step / rise)
    return found


def _noise_N(ways: Sequence[Excerpt]) -> tuple[float, float]:
    noise_N = np.concatenate([way.noise_N for way in ways])
    spread = 2.0 * float(noise_N.std()) / math.sqrt(len(noise_N))
    return float(np.median(noise_N)), math.hypot(spread, NOISE_SHARE * float(np.median(noise_N)))


def _of_sensor(ways: Sequence[Excerpt], force: Fitted) -> dict[str, Told]:
    """Return what needs no law: the sensor's noise, drift and rate, the supply, and the device's clock."""
    noise_N, width_N = _noise_N(ways)
    drift_mN_min = float(np.mean([abs(zero["drift_mN_min"]) for zero in force.zeros]))
    rows, readings, ticks = (
        float(sum(each))
        for each in zip(*((len(way.ticks), way.readings.sum(), way.ticks.sum()) for way in ways), strict=True)
    )
    found = {
        "force_sensor.noise_mN": Told(1e3 * noise_N, 1e3 * width_N),
        "electronics.supply_V": Told(float(np.mean([way.supply_V for way in ways])), 0.5 * SUPPLY_STEP_V),
        "firmware.clock_ppm": Told(float(np.mean([way.clock_ppm for way in ways])), CLOCK_PPM),
    }
    if (width_mN_min := 1e3 * force.estimate.width_of("drift_N_min")) <= TOLD * DRIFT_MN_MIN:
        found["force_sensor.drift_mN_min"] = Told(drift_mN_min, width_mN_min)
    if readings < EVERY_TICK * ticks:
        rate_Hz = readings / rows * GRID_HZ
        found["force_sensor.rate_Hz"] = Told(rate_Hz, RATE_SHARE * rate_Hz)
    return found


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE.mcap", help="recordings of one device, unthinned")
    parser.add_argument("--out", type=Path, metavar="PLANT.toml", help="write the plant, a new file")
    parser.add_argument("--prior", default="sample_1", metavar="PLANT", help="what is believed before (sample_1)")


def run(options: argparse.Namespace) -> Found:
    if options.out is not None and options.out.exists():
        raise LabError(f"{options.out} exists; allowed is a new file")
    prior = load_plant(options.prior)
    ways = [excerpt_of(path) for path in options.files]
    twin = twin_of(prior, ways)
    figures = figures_of(twin, prior, ways)
    head = [*figures["says"], f"fitted by tormag-lab twin to {', '.join(way.name for way in ways)}"]
    if options.out is not None:
        write_plant(options.out, twin, head)
    return Found(figures, exit_code=0 if twin.is_explained else 1)


def figures_of(twin: Twin, prior: PlantParameters, ways: Sequence[Excerpt]) -> dict[str, Any]:
    strength = value_at(twin.plant, STRENGTH) / value_at(prior, STRENGTH)
    error_mN, noise_mN = 1e3 * twin.force.error_N, 1e3 * twin.noise_N
    says = [
        f"force is {strength:.3g} of the prior's: magnets, insert and the sensor's gain share that; a weight tells the "
        "gain (tormagctl commission --weight-N)"
    ]
    if abs(strength - 1.0) > BELIEVED:
        says.append("NOT BELIEVED as the device's without a weight: a sensor of another gain looks like that")
    if not twin.is_explained:
        says.append(
            f"NOT EXPLAINED: the laws leave {error_mN:.0f} mN of the force and {twin.gap_error_mm:.2g} mm of the gap"
        )
    unknown = [key for key in keys_of(prior) if key not in twin.keys]
    return {
        "says": says,
        "cut_out": twin.force.cut_out,
        "field_law": twin.plant.field.law,
        "told": [
            {"name": name, "value": told.value, "half_width": told.half_width}
            for name, told in (twin.combinations | twin.keys).items()
            if told.half_width == told.half_width
        ],
        "unknown": [{"name": key, "prior": value_at(prior, key), "motion": motion_for(key)} for key in unknown],
        "sensors": [{"file": way.name, **zero} for way, zero in zip(ways, twin.force.zeros, strict=True)],
        "model_error": {
            "force_mN": error_mN,
            "sensor_noise_mN": noise_mN,
            "gap_mm": twin.gap_error_mm,
            "is_explained": twin.is_explained,
        },
    }


def motion_for(key: str) -> str:
    """Say what would tell a key that the recordings do not: a motion, or else a data sheet."""
    return MOTIONS.get(key) or MOTIONS.get(key.split(".")[0], DATASHEET)


def write_plant(path: Path, twin: Twin, head: list[str]) -> None:
    text = "\n".join([*(f"# {line}" for line in head), *_lines(twin)]) + "\n"
    try:
        with new_file(path):
            path.write_text(text, encoding="utf-8")
            load_plant(path)
    except FileExistsError as error:
        raise LabError(f"{path} exists; allowed is a new file") from error
    except ValueError as error:
        raise LabError(f"what fits best is no plant: {error}") from error


def _lines(twin: Twin) -> Iterator[str]:
    tables: dict[str, Any] = msgspec.to_builtins(twin.plant)
    usual = msgspec.to_builtins(Assumed())
    for title in PlantParameters.__struct_fields__:
        table = tables[title]
        if table is None or (title == "assumed" and table == usual):
            continue
        yield f"\n[{title}]"
        for name, value in table.items():
            key = f"{title}.{name}"
            yield f"{name} = {msgspec.json.encode(_short(value)).decode()}  # {_comment(twin, key, value)}"


def _short(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_short(each) for each in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _comment(twin: Twin, key: str, value: Any) -> str:
    """Say how sure a key's value is, or what would tell it."""
    if isinstance(value, list | tuple):
        told = [twin.keys.get(f"{key}.{place}") for place in range(len(value))]
        if any(told):
            words = ["unknown" if each is None else f"± {each.half_width:.2g}" for each in told]
            return f"told: {', '.join(words)}" + ("" if all(told) else f"; {motion_for(key)}")
    elif key in twin.keys:
        share = ", for all that shares it" if key in STANDS_FOR else ""
        return f"told: ± {twin.keys[key].half_width:.2g}{share}"
    if key == "field.law":
        return "chosen: it leaves less of the force than the other law"
    if key == "field.coefficient" and EXPONENT in twin.keys:
        return f"turned with the exponent about {PIVOT_MM:g} mm"
    if key.startswith("assumed."):
        return "assumed, as in the prior"
    return f"unknown, the prior's: {motion_for(key)}"
