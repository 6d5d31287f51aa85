"""Why the scene `vitreoretinal` is not met: its error with one thing of device or hand other than it is.

    unmet_scene.py [--json]

All terms, at the usual rates, while the device is learned, on samples 1 to 3, which are synthetic.
"""

import argparse
import json
import sys
from collections.abc import Callable
from typing import NamedTuple

from force_tracking import SAMPLES
from msgspec.structs import replace
from rendering.scene_runs import Case, plant_of, run, turning
from tqdm import tqdm

from tormagd.scenes.scene import load_scene
from tormagd.simulation.parameters import PlantParameters

SCENE = "vitreoretinal"
KNOWN_MM_S, KNOWN_S = 10.0, 8.0
"A handle that teaches what the device is, before the scene's own speeds."


class Other(NamedTuple):
    """What is other, and where it is."""

    name: str
    device: Callable[[PlantParameters], PlantParameters] = lambda plant: plant
    is_known: bool = False


OTHERS = (
    Other("as it is"),
    Other(
        "nothing relaxes",
        lambda plant: replace(
            plant, relaxation=replace(plant.relaxation, fractions=(0.0,) * len(plant.relaxation.fractions))
        ),
    ),
    Other(
        "sliding friction alone", lambda plant: replace(plant, friction=replace(plant.friction, static_to_kinetic=1.0))
    ),
    Other("no field hysteresis", lambda plant: replace(plant, field=replace(plant.field, hysteresis_percent=0.0))),
    Other("no sensor noise", lambda plant: replace(plant, force_sensor=replace(plant.force_sensor, noise_mN=0.0))),
    Other(f"the handle at {KNOWN_MM_S:g} mm/s before", is_known=True),
)


def main() -> int:
    """Prints a table; 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    rows = {other.name: missed_N(other) for other in tqdm(OTHERS, disable=not sys.stderr.isatty())}
    if options.json:
        print(json.dumps({"scene": SCENE, "tolerance_N": load_scene(SCENE).force.tolerance_rms_N, "rms_N": rows}))
        return 0
    print(f"{'RMS, mN':32s}{''.join(f'{sample:>10s}' for sample in SAMPLES)}")
    for name, errors_N in rows.items():
        print(f"{name:32s}{''.join(f'{1e3 * error_N:10.1f}' for error_N in errors_N.values())}")
    return 0


def missed_N(other: Other, samples: tuple[str, ...] = SAMPLES) -> dict[str, float]:
    """RMS error of the force on each sample."""
    scene = load_scene(SCENE)
    hand = turning(scene.handle, KNOWN_MM_S, KNOWN_S) if other.is_known else None
    return {sample: run(Case(SCENE, sample), other.device(plant_of(scene, sample)), hand) for sample in samples}


if __name__ == "__main__":
    sys.exit(main())
