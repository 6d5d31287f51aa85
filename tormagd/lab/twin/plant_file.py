"""Writes a plant as a file: each line says whether it is told, and how sure, or which motion would tell it."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from tormagd.lab.errors import LabError
from tormagd.lab.twin.fit import STANDS_FOR, Twin
from tormagd.lab.twin.force import EXPONENT, PIVOT_MM
from tormagd.simulation.parameters import Assumed, PlantParameters, load_plant

SLIDE = "slide the handle both ways at over 20 mm/s for a minute, at several forces"
STEPS = "step from the least force to the most and back, ten times"
HOLD = "hold the most force for a minute and the least for a minute, five times, the handle turning"
SLOWLY = "turn the handle to and fro from a stop up to 40 mm/s, ten times"
DATASHEET = "no motion tells it: take it from its data sheet"
MOTIONS: Mapping[str, str] = {
    "elastomer.kinetic_friction": SLIDE,
    "elastomer.shear_modulus_kPa": "no motion tells it from the field's exponent: characterise the insert",
    "elastomer.relative_permeability": "no motion tells it from the strength: characterise the insert",
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
"By key or table, what would tell it."


def motion_for(key: str) -> str:
    """Return, in words, what would tell a key that the recordings do not; for a key without a motion, that a data sheet
    does."""
    return MOTIONS.get(key) or MOTIONS.get(key.split(".")[0], DATASHEET)


def write_plant(path: Path, twin: Twin, head: list[str]) -> None:
    """Write the plant to the new file `path`, with the lines of `head` as comments above, and read it again.

    Lines of `head` have no line ends. Raises LabError where the file exists, or what was fitted is no plant; then there
    is no new file. Raises OSError, which may leave a part of the file.
    """
    text = "\n".join([*(f"# {line}" for line in head), *_lines(twin)]) + "\n"
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
        load_plant(path)
    except FileExistsError as error:
        raise LabError(f"{path} exists; allowed is a new file") from error
    except ValueError as error:
        path.unlink()
        raise LabError(f"what fits best is no plant: {error}") from error


def _lines(twin: Twin) -> Iterator[str]:
    """Yield the lines of the plant file: each table's head after an empty line, then `key = value # comment` for each
    key.

    Numbers have six digits. Tables that the plant has not, and what is assumed as usual, are left out.
    """
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
    """Return a number, or each of a list, to six digits."""
    if isinstance(value, list | tuple):
        return [_short(each) for each in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _comment(twin: Twin, key: str, value: Any) -> str:
    """Return the comment of a key: how sure it is, or what would tell it.

    `value` is a number, a list of them or a name. Of a list each number's half width is told.
    """
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
