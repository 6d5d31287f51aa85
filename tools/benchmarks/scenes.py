"""`benchmark scenes`: what each scene costs and misses with all terms, and with those that were chosen for it.

Nothing is measured here: the errors on the simulated device, and the costs beside their own `measured_machine_us`, are
those that `required_terms.py --store` measured.
"""

import argparse

import msgspec

from tormagd.assembly.build import Core, build_core
from tormagd.config import Config
from tormagd.lab.arrays import Json
from tormagd.scenes.measured import MeasuredScene, measured, on_first
from tormagd.scenes.scene import EVERY_TERM, TERMS, load_scene


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """None of its own."""


def measure(options: argparse.Namespace) -> Json:
    """`{scenes: [...], measured_machine_us}`: each scene's figures."""
    file = measured()
    return {"scenes": [figures(scene) for scene in file.scenes], "measured_machine_us": file.machine_us}


def figures(scene: MeasuredScene) -> Json:
    """One scene's decision as numbers. `full` is every term at the usual rates."""
    on_sample_1 = on_first(scene.judged)
    return {
        "name": scene.name,
        "terms_in": [term for term in TERMS if term not in scene.left_out],
        "terms_out": list(scene.left_out),
        "control_hz": scene.control_hz,
        "inference_hz": scene.inference_hz,
        "solver": core_without(scene.name, scene.left_out).solver.solver,
        "rms_N": on_sample_1.chosen_N,
        "rms_full_N": on_sample_1.full_N,
        "tolerance_N": scene.tolerance_N,
        "cost_us_per_s": scene.cost_us_s,
        "cost_full_us_per_s": scene.cost_full_us_s,
    }


def core_without(name: str, left_out: tuple[str, ...]) -> Core:
    """The core of a shipped scene without these terms."""
    terms = EVERY_TERM.without(*left_out)
    return build_core(Config(scene=name), msgspec.structs.replace(load_scene(name), terms=terms))
