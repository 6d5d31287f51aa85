"""What two parts of the term `motor` do by themselves, dry friction and the magnets' pull, beside the whole term and
`lag`, the other one that is there for the gap's motion.

    motor_parts.py [--json]

The force is that of SCENES at the rates chosen for them, while the device is learned; the motion is that of steps of
1 mm, both ways over the stroke, and of the stroke itself: of the samples, of DRAWS, and of one that nobody greased. All
devices are synthetic.
"""

import argparse
import json
import sys

import msgspec
from benchmarks.step import START_MM, STEP_MM, overshoot_over_stroke, settled_loop, step, stroke
from force_tracking import SAMPLES
from rendering.device_draws import drawn_device
from rendering.scene_runs import Case, run

from tormagd.config import Config, Motor
from tormagd.scenes.measured import measured
from tormagd.simulation.parameters import PlantParameters, load_plant

SCENES = "pulse", "radial_pulse", "coronary"
NOTHING = "nothing"
TERMS = "lag", "motor"
PARTS = {"friction": Motor(coulomb_V=0.0), "pull": Motor(pull_V=0.0)}
"A motor that is configured without one has none of it fed forward."
MOVING = NOTHING, "motor", *PARTS
DRAWS = range(40, 50)
"Devices that chose nothing."
DRY_DRAG_N, DRY_EFFICIENCY, DRY_FRICTION = 20.0, 0.55, 0.3
"Of sample 1 with over three times its drag, a gearbox that loses half as much again, and a nut that rubs so much more."


def main() -> int:
    """Prints both tables; 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    rates = {scene.name: scene.hz for scene in measured().scenes}
    added_N = {name: {sample: added(name, sample, rates[name]) for sample in SAMPLES} for name in SCENES}
    devices = {name: [load_plant(name)] for name in SAMPLES}
    devices |= {"draws": [drawn_device(number) for number in DRAWS], "dry": [dry_device()]}
    motion = {without: {name: worst(of, without) for name, of in devices.items()} for without in MOVING}
    if options.json:
        print(json.dumps({"added_N": added_N, "motion": motion}))
        return 0
    for name, samples in added_N.items():
        for sample, found in samples.items():
            rows = ", ".join(f"{without} {1e3 * more_N:.1f}" for without, more_N in found.items())
            print(f"{name:13s}{sample}  added, mN, without {rows}")
    for without, moves in motion.items():
        for sample, row in moves.items():
            print(
                f"without {without:10s}{sample}  overshoot {row['overshoot']:.1%}, settling "
                f"{1e3 * row['settling_s']:.0f} ms, stroke {1e3 * row['stroke_s']:.0f} ms"
            )
    return 0


def added(scene: str, sample: str, hz: tuple[int, int]) -> dict[str, float]:
    """What each one's absence adds to the RMS error of the force, N, at rates of control and of inference."""
    case = Case(scene, sample, (), "", True, *hz)
    full_N = run(case)
    terms = {term: run(msgspec.structs.replace(case, left_out=(term,))) - full_N for term in TERMS}
    return terms | {part: run(case, motor=motor) - full_N for part, motor in PARTS.items()}


def dry_device() -> PlantParameters:
    """Sample 1 as nobody greased it."""
    plant = load_plant(SAMPLES[0])
    screw = msgspec.structs.replace(
        plant.screw, drag_left_N=DRY_DRAG_N, drag_right_N=DRY_DRAG_N, friction_coefficient=DRY_FRICTION
    )
    return msgspec.structs.replace(
        plant, screw=screw, gear=msgspec.structs.replace(plant.gear, efficiency=DRY_EFFICIENCY)
    )


def worst(devices: list[PlantParameters], without: str) -> dict[str, float]:
    """The worst of each figure of these devices."""
    found = [moved(device, without) for device in devices]
    return {name: max(row[name] for row in found) for name in found[0]}


def moved(device: PlantParameters, without: str) -> dict[str, float]:
    """The greatest overshoot, the longer settling of both ways at START_MM, and the time of the stroke."""
    config = Config(motor=PARTS[without]) if without in PARTS else Config()
    loop = settled_loop(config, device, (without,) if without in TERMS else ())
    steps = step(loop, START_MM + STEP_MM), step(loop, START_MM)
    stroke_s = stroke(loop)
    return {
        "overshoot": overshoot_over_stroke(loop),
        "settling_s": max(each.settling_5pct_s for each in steps),
        "stroke_s": stroke_s,
    }


if __name__ == "__main__":
    sys.exit(main())
