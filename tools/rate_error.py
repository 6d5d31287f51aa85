"""How far a brake's model is off over the handle's rate, where it is right at the roller's 42 mm/s.

    rate_error.py [--json]

Against the friction of the device that it was learned from, sample 1, which is synthetic. And what SCENE misses of it,
learned before and frozen, with all terms and without one, while the handle swings as it states, and faster.
"""

import argparse
import json
import sys

import numpy as np
from rendering.scene_runs import Case, run, turning

from tormagd.control.contact import ROLLER_RATE_MM_S
from tormagd.model.model_file import ForceModel, load_model
from tormagd.model.shipped import model_path
from tormagd.physics.friction import Friction
from tormagd.scenes.scene import RELAXATION_S, Handle, load_scene, scene_path
from tormagd.simulation.parameters import load_plant

SCENE, SAMPLE = "aorta_1", "sample_1"
FORCES_N = 1.0, 1.5, 2.0, 2.5
RATES_MM_S = 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, 40.0
FASTER_MM_S = 20.0
LEFT_OUT = {"nothing": (), "rate": ("rate",), "offset": ("offset",), "relaxation": tuple(RELAXATION_S)}


def main() -> int:
    """Prints a table; 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    scene = load_scene(SCENE)
    model, friction = model_and_friction()
    errors_N = {force_N: error_N(model, friction, force_N) for force_N in FORCES_N}
    slowest_mm_s, fastest_mm_s = scene.handle.least_mm_s, scene.handle.most_mm_s
    frozen_N = {
        f"{least_mm_s:g} to {fastest_mm_s:g} mm/s": frozen_error_N(Handle(least_mm_s, fastest_mm_s))
        for least_mm_s in (slowest_mm_s, FASTER_MM_S)
    }
    if options.json:
        print(json.dumps({"scene": SCENE, "rates_mm_s": RATES_MM_S, "error_N": errors_N, "frozen_N": frozen_N}))
        return 0
    print(f"{'mN at mm/s':12s}{''.join(f'{rate:8g}' for rate in RATES_MM_S)}")
    for force_N, row in errors_N.items():
        print(f"{force_N:8g} N  {''.join(f'{1e3 * error:8.1f}' for error in row)}")
    for swings, rows in frozen_N.items():
        print(
            f"frozen, {swings}, mN without: " + ", ".join(f"{name} {1e3 * rms_N:.1f}" for name, rms_N in rows.items())
        )
    return 0


def model_and_friction() -> tuple[ForceModel, Friction]:
    """The scene's model, and what it should have learned."""
    name, device = load_scene(SCENE).insert.model, load_plant(SAMPLE).friction
    friction = Friction(
        device.presliding_stiffness_N_mm, device.viscous_N_s_mm, device.static_to_kinetic, device.stribeck_speed_mm_s
    )
    return load_model(model_path(name, beside=scene_path(SCENE).parent), element="torque"), friction


def error_N(model: ForceModel, friction: Friction, force_N: float) -> list[float]:
    """The model's force less the device's at RATES_MM_S, in the field where the model gives `force_N` at 42 mm/s."""
    (displacement_mm, _), _, fields_mT, (cip_percent, _) = model.feature_ranges
    at_roller = model.curve(displacement_mm, ROLLER_RATE_MM_S, cip_percent)
    grid_mT = np.linspace(*fields_mT, 1_000)
    field_mT = float(np.interp(force_N, [at_roller.force_N(each_mT) for each_mT in grid_mT.tolist()], grid_mT))
    kinetic_N = (force_N - friction.viscous_N_s_mm * ROLLER_RATE_MM_S) / friction.level_N(ROLLER_RATE_MM_S, 1.0)
    return [
        model.predict_one(displacement_mm, rate_mm_s, field_mT, cip_percent)
        - friction.level_N(rate_mm_s, kinetic_N)
        - friction.viscous_N_s_mm * rate_mm_s
        for rate_mm_s in RATES_MM_S
    ]


def frozen_error_N(handle: Handle) -> dict[str, float]:
    """RMS error of the force at the scene's rates, by what is left out."""
    scene = load_scene(SCENE)
    hz = scene.bandwidth.control_hz, scene.bandwidth.inference_hz
    return {
        name: run(Case(SCENE, SAMPLE, left_out, "", False, *hz), hand=turning(handle))
        for name, left_out in LEFT_OUT.items()
    }


if __name__ == "__main__":
    sys.exit(main())
