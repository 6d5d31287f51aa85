"""Fits a plant file to recordings of one device: the simulator's laws, by regression, without simulating.

tormag-lab twin FILE.mcap ... --out mine.toml

Ordinary use serves: ten minutes with steps, pulses and holds, the handle going both ways. A number is told where its
95 % interval is at most half as wide as what is believed of any device. What is not told keeps the prior's value, and
the motion that would tell it is named. Magnets, insert and the sensor's gain share the strength: only a weight parts
them (tormagctl commission --weight-N). A sensor that stands still is cut out, one that drifts is refused. What the
laws do not explain is the model error. Exit code 1: it is too large for the plant to stand for this device.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tormagd.lab.errors import LabError
from tormagd.lab.main import Found
from tormagd.lab.pages import draw_beside
from tormagd.lab.twin.estimate import keys_of, value_at
from tormagd.lab.twin.excerpt import Excerpt, excerpt_of
from tormagd.lab.twin.fit import EXPLAINED_N, Twin, twin_of
from tormagd.lab.twin.force import STRENGTH, along, fresh_along
from tormagd.lab.twin.plant_file import motion_for, write_plant
from tormagd.simulation.parameters import PlantParameters, load_plant

MAX_FILES = 10
BELIEVED = 0.4
"No device of the plant card is further off sample 1's strength."


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `tormag-lab twin`."""
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE.mcap", help="recordings of one device, unthinned")
    parser.add_argument("--out", type=Path, metavar="PLANT.toml", help="write the plant, a new file")
    parser.add_argument("--prior", default="sample_1", metavar="PLANT", help="what is believed before (sample_1)")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw measured and explained force")


def run(options: argparse.Namespace) -> Found:
    """Fit a plant to the recordings `options.files`, and return what is told, what is not, and the model error.

    The figures are as `figures_of`. The exit code is 1 where the laws do not explain the device. The plant is written
    to `options.out`, and drawn to `options.plot`, all the same. A picture that is there is replaced, a plant is
    refused. Raises LabError for recordings or a sensor that are refused, PlantError for the prior. Raises OSError where
    a file cannot be written, ModuleNotFoundError for a picture without matplotlib.
    """
    if options.out is not None and options.out.exists():
        raise LabError(f"{options.out} exists; allowed is a new file")
    if options.plot is not None and options.plot.suffix != ".png":
        raise LabError(f"--plot {options.plot}: allowed is a name that ends with .png")
    if len(options.files) > MAX_FILES:
        raise LabError(f"{len(options.files)} recordings: allowed are {MAX_FILES}")
    prior = load_plant(options.prior)
    ways = [excerpt_of(path) for path in options.files]
    twin = twin_of(prior, ways)
    figures = figures_of(twin, prior, ways)
    head = [*figures["says"], f"fitted by tormag-lab twin to {', '.join(way.name for way in ways)}"]
    if options.out is not None:
        write_plant(options.out, twin, head)
    if options.plot is not None:
        draw(options.plot, twin, ways[0])
    return Found(figures, exit_code=0 if twin.is_explained else 1)


def figures_of(twin: Twin, prior: PlantParameters, ways: Sequence[Excerpt]) -> dict[str, Any]:
    """Return a twin as plain data: numbers with half the width of their 95 % intervals, and sentences.

    `prior` and `ways` are those of `twin_of`. `says` are sentences for a person, `cut_out` those of the sensor,
    `field_law` the law's name. `told` has `name`, `value` and `half_width` of combinations and keys, `unknown` the
    other keys with `name`, `prior` and `motion`, in words. `sensors` has `file`, `zero_mN` and `drift_mN_min` of each
    recording. `model_error` has `force_mN`, `sensor_noise_mN`, `gap_mm` and `is_explained`.
    """
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


def draw(path: Path, twin: Twin, way: Excerpt) -> None:
    """Draw the measured force of one recording, what the plant explains of it, and the difference, to the PNG file
    `path`.

    `way` has to be the first recording of the twin: its zero and memory are taken. A file there is replaced. Raises
    OSError, and ModuleNotFoundError where matplotlib is not installed.
    """
    zero_N = 1e-3 * (twin.force.zeros[0]["zero_mN"] + twin.force.zeros[0]["drift_mN_min"] * way.minute)
    explained_N = along(twin.plant, way, twin.force.memory_N, fresh_along(twin.plant, way)) + zero_N
    draw_beside(
        path,
        way.time_s,
        way.force_N,
        explained_N,
        labels=("by the plant's laws", "force, N", "difference, mN"),
        title=f"Model error {1e3 * twin.force.error_N:.1f} mN RMS, allowed {1e3 * EXPLAINED_N:g}",
        widths=(0.6, 0.6, 0.5),
        finer=1e3,
    )
