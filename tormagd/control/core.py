"""The functional core put together for one scene: `plan` and `step` with their constants.

The daemon, the virtual-time simulation and the tests build it here, so that all of them run the same one.
"""

import hashlib
import math
from pathlib import Path
from typing import NamedTuple

import msgspec
from msgspec import UNSET

from tormagd.config import Config, ConfigError
from tormagd.control.device_fit import LEAST_SCALE
from tormagd.control.motor import Margins, margins, pull_V
from tormagd.control.plan import CEILING, Planner
from tormagd.control.portrait import FieldOfGap, Portrait, PortraitSearch, law_beside, portrait
from tormagd.control.renderable import Missed, missed
from tormagd.control.step import Stepper
from tormagd.inverse.choice import Choice, build, named
from tormagd.model.model_file import ForceModel, ModelFileError, load_model
from tormagd.model.rising import falling_at
from tormagd.model.shipped import model_path
from tormagd.physics.errors import DomainError
from tormagd.physics.field import PowerFieldLaw
from tormagd.physics.force import Geometry
from tormagd.physics.inserts import insert
from tormagd.scenes.scene import AUTO, LEAST_CONTROL_HZ, Insert, Scene, load_scene, scene_path, terms_of
from tormagd.scenes.signal import asked

ELEMENT = "torque"
LEAST_PHASE_MARGIN_DEG = 30.0
LEAST_GAIN_MARGIN_DB = 4.0
SOURCES = ("firmware_protocol", *(f"tormagd/{it}" for it in ("physics", "model", "inverse", "safety", "scenes")))
SOURCES += ("tormagd/hardware", "tormagd/control")
SENSED_N = 0.001
"A step of the force sensor's message."
SETTLES_MM = 4.0 * 8.0 / 4480.0
"To within four counts of the encoders the gap comes to rest, wherever in its stroke: friction holds it there."
LOOKED_AT_S, LOOKED_AT_HZ, LOOKS = 30.0, 100, 20
"So much of a scene's signal is held against the device's speed, as often as this, and so often in a period."
IN_PORTRAIT = Choice("portrait", 0.0, 0, "the scene requires no rate: force over gap is one table")
BY_NEWTON = named("newton", reason="of the searches the cheapest, and the most exact")
"At every tolerance and for every size of network: docs/inverse_trade.md, and docs/scenes.md on the device."


class Core(NamedTuple):
    """What one scene's control needs; nothing in it changes."""

    scene: Scene
    planner: Planner
    stepper: Stepper
    margins: Margins
    solver: Choice
    model: str
    "The model's fingerprint."
    models: Path
    "Where the scene's model was looked for, where it is no shipped one."
    gap_speed_mm_s: float
    "The fastest that the gap is moved."
    missed: Missed | None = None
    "What the gap's speed alone leaves of the scene's signal; None where it states none."


def build_core(config: Config, scene: Scene | None = None, models: Path | None = None) -> Core:
    """The core for `config.scene`. Raises ConfigError where scene, model and configuration do not fit each other.

    A given `scene` takes the place of the one in the file; its files are beside that one, or its model in the folder
    `models`: then it has been checked, and its signal is not looked for.
    """
    beside = scene_path(config.scene).parent.absolute() if models is None else models
    scene = load_scene(config.scene) if scene is None else scene
    config = _slowed(config, scene)
    if scene.element != ELEMENT:
        raise ConfigError(
            f"scene {scene.name}: element = {scene.element!r}: allowed is {ELEMENT!r}: a pad's force depends on its "
            "whole history, which no model that the daemon can run knows yet"
        )
    for name in ("control_hz", "inference_hz"):
        offered, needed = getattr(config.rates, name), getattr(scene.bandwidth, name)
        if offered < needed:
            raise ConfigError(f"rates.{name} = {offered}: allowed is at least {needed}, which scene {scene.name} needs")
    stability = margins(config.motor, config.position, 1.0 / config.rates.control_hz)
    if stability.phase_margin_deg < LEAST_PHASE_MARGIN_DEG or stability.gain_margin_dB < LEAST_GAIN_MARGIN_DB:
        raise ConfigError(
            f"position: these gains leave a phase margin of {stability.phase_margin_deg:.0f} degrees and a gain margin "
            f"of {stability.gain_margin_dB:.1f} dB: allowed is at least {LEAST_PHASE_MARGIN_DEG:g} and "
            f"{LEAST_GAIN_MARGIN_DB:g}"
        )
    _refuse_too_weak(config, scene)
    try:
        fitted = insert(scene.insert.name)
        model = load_model(
            model_path(scene.insert.model, beside=beside),
            element=scene.element,
            insert=scene.insert.name,
        )
    except (DomainError, ModelFileError) as error:
        raise ConfigError(f"scene {scene.name}: {error}") from error
    law, cip_percent = PowerFieldLaw(), 100.0 * fitted.cip_fraction
    field = FieldOfGap(law, fitted.elastomer.relative_permeability, scene.insert.inner_radius_mm * 1e-3)
    try:
        fields_mT = _known_fields_mT(scene, model, field)
        reach = portrait(model, field, cip_percent, (field.gap_mm(fields_mT[1]), field.gap_mm(fields_mT[0])))
        choice = choose_solver(scene)
        search = PortraitSearch(reach, field) if choice is IN_PORTRAIT else build(choice, fields_mT, rises=True)
    except DomainError as error:
        raise ConfigError(f"scene {scene.name}: {error}") from error
    _refuse_out_of_reach(scene, reach)
    _refuse_too_fine(scene, reach)
    _refuse_unknown_handle(scene, model)
    too_fast = _refuse_too_fast(config, scene, reach, beside) if models is None else None
    _refuse_too_sudden(config, scene, reach)
    law_of_field = law_beside(reach, law, field, fitted.elastomer, _geometry(scene.insert))
    planner = Planner(config, scene, model, search, field, reach, law_of_field, cip_percent)
    stepper, speed_mm_s = Stepper(config, scene), config.position.gap_speed_mm_s
    return Core(scene, planner, stepper, stability, choice, model.fingerprint, beside, speed_mm_s, too_fast)


def sources_hash() -> str:
    """SHA-256 of the sources that decide: all that `plan` and `step` run. Both builds of them have the same."""
    root, digest = Path(__file__).parents[2], hashlib.sha256()
    for room in SOURCES:
        for path in sorted((root / room).glob("**/*.py")):
            digest.update(f"{path.relative_to(root).as_posix()} {path.stat().st_size}\n".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _known_fields_mT(scene: Scene, model: ForceModel, field: FieldOfGap) -> tuple[float, float]:
    """The fields of the scene's gaps, as far as the model knows them and knows that they give more force."""
    low_mT, high_mT = model.field_range_mT
    low_mT = max(low_mT, field.field_mT(scene.insert.gap_open_mm))
    high_mT = min(high_mT, field.field_mT(scene.insert.gap_closed_mm))
    if not low_mT < high_mT:
        raise DomainError("insert.model", f"trained on {model.field_range_mT} mT", "fields that the scene's gaps give")
    falling_mm_s = falling_at(model, (low_mT, high_mT))
    if falling_mm_s is not None:
        raise DomainError(
            "insert.model",
            f"force that falls with the field at {falling_mm_s:.3g} mm/s",
            "a force that rises with the field: train it on more data, as tools/train_model.py --rising checks",
        )
    return low_mT, high_mT


def _geometry(fitted: Insert) -> Geometry:
    radii_mm = fitted.inner_radius_mm, fitted.outer_radius_mm
    return Geometry(radii_mm[0] * 1e-3, radii_mm[1] * 1e-3, fitted.thickness_mm * 1e-3, fitted.roller_radius_mm * 1e-3)


def _refuse_too_weak(config: Config, scene: Scene) -> None:
    motor, closed_mm = config.motor, scene.insert.gap_closed_mm
    needed_V = motor.coulomb_V + pull_V(motor.pull_V, closed_mm)
    most_V = config.position.duty_limit * motor.supply_V / 2.0
    if needed_V > most_V:
        raise ConfigError(
            f"motor: coulomb_V = {motor.coulomb_V:g} and pull_V = {motor.pull_V:g} take {needed_V:.2f} V to open the "
            f"gap from {closed_mm:g} mm: allowed is {most_V:g} V, half of position.duty_limit times motor.supply_V"
        )


def _refuse_out_of_reach(scene: Scene, reach: Portrait) -> None:
    # a lowest force below what the open gap gives is no error: no passive brake gives 0, and the limit F_MIN says so
    between = f"allowed is {reach.least_N:.2f}..{reach.most_N:.2f}, what model {scene.insert.model} gives in these gaps"
    if not reach.least_N < scene.force.most_N <= reach.most_N:
        raise ConfigError(f"scene {scene.name}: force.most_N = {scene.force.most_N:g}: {between}")


def at_rates_of(scene: Scene, config: Config) -> Config:
    """The configuration with the rates that the scene needs, where `rates.of_scene` says so. Raises ConfigError."""
    if not config.rates.of_scene:
        return config
    needed = scene.bandwidth
    control_hz = max(needed.control_hz, LEAST_CONTROL_HZ)
    rates = msgspec.structs.replace(config.rates, control_hz=control_hz, inference_hz=needed.inference_hz)
    try:
        return msgspec.structs.replace(config, rates=rates)
    except ValueError as error:
        raise ConfigError(f"scene {scene.name}: rates.of_scene: {error}") from error


def _slowed(config: Config, scene: Scene) -> Config:
    """The configuration with the scene's gap speed, where that is the lower one."""
    position, asked_mm_s = config.position, scene.insert.gap_speed_mm_s
    if asked_mm_s is UNSET or asked_mm_s >= position.gap_speed_mm_s:
        return config
    return msgspec.structs.replace(config, position=msgspec.structs.replace(position, gap_speed_mm_s=asked_mm_s))


def least_resolution_N(reach: Portrait, most_N: float) -> float:
    """The smallest difference of force that the device makes and measures, up to this force."""
    return max(SENSED_N, SETTLES_MM * reach.slope_at_N_mm(most_N))


def _refuse_too_fine(scene: Scene, reach: Portrait) -> None:
    least_N = least_resolution_N(reach, scene.force.most_N)
    if scene.force.resolution_N < least_N:
        raise ConfigError(
            f"scene {scene.name}: force.resolution_N = {scene.force.resolution_N:g}: allowed is at least {least_N:.2g}"
            f": the force sensor has steps of {SENSED_N:g} N, and the gap settles to {1e3 * SETTLES_MM:.0f} um"
        )


def _refuse_unknown_handle(scene: Scene, model: ForceModel) -> None:
    slowest_mm_s, fastest_mm_s = model.feature_ranges[1]
    handle = scene.handle
    for key, value in (("least_mm_s", handle.least_mm_s), ("most_mm_s", handle.most_mm_s)):
        if not slowest_mm_s <= value <= fastest_mm_s:
            raise ConfigError(
                f"scene {scene.name}: handle.{key} = {value:g}: allowed is {slowest_mm_s:.2g}..{fastest_mm_s:.0f}, the "
                f"rates that model {scene.insert.model} was trained on"
            )


def _refuse_too_fast(config: Config, scene: Scene, reach: Portrait, beside: Path) -> Missed | None:
    if scene.signal is None:
        return None
    force, speed_mm_s = scene.force, config.position.gap_speed_mm_s
    range_N = max(force.least_N, reach.least_N), force.most_N
    bandwidth_hz = 0.0 if scene.signal.bandwidth_hz is UNSET else scene.signal.bandwidth_hz
    rate_hz = max(LOOKED_AT_HZ, math.ceil(LOOKS * bandwidth_hz))
    times_s, forces_N = asked(scene.signal, beside, range_N, LOOKED_AT_S, rate_hz)
    miss = missed(reach, times_s.tolist(), forces_N.tolist(), speed_mm_s)
    if miss.rms_N > force.tolerance_rms_N:
        worst = ", ".join(
            f"{point.asked_N_s:.2g} N/s at {point.force_N:.2f} N (the device: {point.given_N_s:.2g})"
            for point in miss.worst
        )
        raise ConfigError(
            f"scene {scene.name}: signal: allowed is what gaps of {speed_mm_s:g} mm/s follow within "
            f"force.tolerance_rms_N = {force.tolerance_rms_N:g}: they miss it by {miss.rms_N:.3f}, {miss.share:.0%} of "
            f"the time is faster: {worst}"
        )
    return miss


def _refuse_too_sudden(config: Config, scene: Scene, reach: Portrait) -> None:
    # the weakest believable device makes a force with the least gap, where a gap's speed is the most force; and the
    # ceiling lets no gap make more than CEILING times the scene's greatest
    opening_mm_s, key = max(
        (2.0 * config.device.retract_mm_s, "device.retract_mm_s"),
        (config.position.gap_speed_mm_s, "position.gap_speed_mm_s"),
    )
    model_N = min(CEILING * scene.force.most_N / LEAST_SCALE, reach.most_N)
    lost_N_s = LEAST_SCALE * reach.force_rate_N_s(model_N, opening_mm_s)
    if lost_N_s > scene.force.most_release_N_s:
        raise ConfigError(
            f"scene {scene.name}: force.most_release_N_s = {scene.force.most_release_N_s:g}: allowed is at least "
            f"{lost_N_s:.2f}: {key} opens the gap by {opening_mm_s:g} mm/s, which at {LEAST_SCALE * model_N:.2g} N "
            "loses so much"
        )


def choose_solver(scene: Scene) -> Choice:
    """The search that `scene` names; else the portrait where the rate is no term, or Newton's method. Raises
    DomainError."""
    wanted = scene.solver
    if wanted.name == AUTO:
        return BY_NEWTON if terms_of(scene).rate else IN_PORTRAIT
    return named(wanted.name, wanted.step_mT or None, wanted.neighbours or None)
