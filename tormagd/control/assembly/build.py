"""The core built for one scene, and the refusals where scene, model and configuration do not fit each other.

The daemon, the virtual-time simulation and the tests build the core here, so that all of them run the same one.
"""

import hashlib
import math
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET

from tormagd.config import Config
from tormagd.control.aim.aim import Element
from tormagd.control.aim.portrait import CEILING, LawOfField, Portrait, PortraitSearch, portrait
from tormagd.control.core import Planner, Stepper
from tormagd.control.move.motor import Margins, gap_speeds, margins, most_closing_mm_s, pull_V
from tormagd.control.nominal import PRESSED, ElementContact, FieldOfGap, Nominal, Pressing, Sliding
from tormagd.control.records import GapSpeeds
from tormagd.element.inverse.choice import BESIDE_PLANS, Choice, build, mean_error_N, named
from tormagd.element.model.features import FEATURES
from tormagd.element.model.memory import NO_MEMORY
from tormagd.element.model.model_file import ForceModel, ModelFileError, falling_at, load_model, model_path
from tormagd.element.physics.errors import DomainError, require
from tormagd.element.physics.field import PAD_RADIUS_M, REFERENCE_PERMEABILITY, PowerFieldLaw
from tormagd.element.physics.force import Geometry, brake_force_N
from tormagd.element.physics.inserts import insert
from tormagd.scenes.scene import AND_UNMET, AUTO, Finger, Scene, load_scene, scene_path
from tormagd.scenes.signal import asked
from tormagd_client.endpoints import ConfigError

MIN_PHASE_MARGIN_DEG = 30.0
MIN_GAIN_MARGIN_DB = 4.0
ROOT = Path(__file__).parents[3]
SOURCES = ("firmware_protocol", "tormagd/element", "tormagd/scenes", "tormagd/hardware", "tormagd/control")
"The rooms of all that `plan` and `step` run."
SENSED_N = 0.001
SETTLES_MM = 4.0 * 8.0 / 4480.0
"Friction holds the gap to within four counts of the encoders."
STANDBY_N = 0.3
"A hand may feel this much over the open gap's force of a brake that waits."
TURNS_S = 0.1
"A gap at its speed comes to rest within this time, or it goes on closing when less is asked."
DEPTHS = 9
"A pad's force is checked at this many depths for whether it rises."
LOOKED_AT_S, LOOKED_AT_HZ, LOOKS = 30.0, 100, 20
"How much of a scene's signal is looked at, how often a second, and how often in a period."
SEVERAL_BRANCHES = named("nearest", neighbours=16, reason="the force falls with the field somewhere")
"With fewer neighbours answers jump between branches; more gain little (docs/tactile.md)."
IN_PORTRAIT = Choice("portrait", 0.0, 0, "the scene requires no rate: force over gap is one table")
BY_NEWTON = named("newton", reason="of the searches the cheapest, and the most exact")
"It is so at every tolerance and network size: docs/inverse_trade.md."


ROUNDED_UP = 1.005
"A number times this, to three digits, is not below the number."


class Missed(NamedTuple):
    """What ideal carriages, which only their top speed bounds, miss of a signal."""

    rms_N: float
    share: float
    "Of the time in which the signal is faster than the gap."


class Core(NamedTuple):
    """All that control of one scene needs, immutable. `planner` and `stepper` make the parts that keep state."""

    config: Config
    "It has the scene's own gap speed."
    scene: Scene
    element: Element
    margins: Margins
    solver: Choice
    model: str
    "The model's fingerprint."
    models: Path
    "Where the model was looked for."
    missed: Missed | None = None
    "What the gap's speed alone leaves of the scene's signal."

    @property
    def gap_speeds(self) -> GapSpeeds:
        return gap_speeds(self.config)

    @property
    def portrait(self) -> Portrait:
        return self.element.portrait

    def planner(self, now_s: float = 0.0) -> Planner:
        return Planner(self.config, self.scene, self.element, now_s)

    def stepper(self, now_s: float = 0.0) -> Stepper:
        return Stepper(self.config, self.scene, now_s)


def build_core(config: Config, scene: Scene | None = None, models: Path | None = None) -> Core:
    """Build the core for a scene, by default `config.scene`. Raises ConfigError where scene, model and configuration do
    not fit.
    """
    beside = scene_path(config.scene).parent.absolute() if models is None else models
    scene = load_scene(config.scene) if scene is None else scene
    config = _slowed(config, scene)
    for name in ("control_hz", "inference_hz"):
        offered, needed = getattr(config.rates, name), getattr(scene.bandwidth, name)
        if offered < needed:
            raise ConfigError(f"rates.{name} = {offered}: allowed is at least {needed}, which scene {scene.name} needs")
    stability = _stable_margins(config)
    _refuse_too_weak(config, scene)
    try:
        model = load_model(
            model_path(scene.insert.model, beside, scene.insert.name), element=scene.element, insert=scene.insert.name
        )
        element, choice = _element(scene, model)
    except (DomainError, ModelFileError) as error:
        raise ConfigError(f"scene {scene.name}: {error}") from error
    miss = _missed(config, scene, element.portrait, beside) if models is None else None
    unmet = [
        *_unknown_hand(scene, model),
        *_out_of_reach(scene, element.portrait),
        *_too_fine(scene, element.portrait),
        *_too_fast(config, scene, miss),
        *_too_sudden(config, scene, element.portrait),
    ]
    if unmet:
        raise ConfigError(f"scene {scene.name}: " + AND_UNMET.join(unmet))
    return Core(config, scene, element, stability, choice, model.fingerprint, beside, miss)


def _element(scene: Scene, model: ForceModel) -> tuple[Element, Choice]:
    """Return the scene's element and the choice of the search for its field."""
    contact, field, cip_percent = _brake(scene) if scene.finger is UNSET else _pad(scene.finger, model)
    require("insert.name, cip_percent", cip_percent, *model.feature_ranges[FEATURES.index("cip_percent")])
    nominal = Nominal(model, contact, cip_percent, scene.terms.rate)
    fields_mT, rises = _known_fields_mT(scene, model, contact, field)
    reach = portrait(nominal.only, field, (field.gap_mm(fields_mT[1]), field.gap_mm(fields_mT[0])))
    choice = choose_solver(scene, rises=rises)
    if choice.solver == "thesis":
        choice = choice._replace(reason=f"{choice.reason}; epsilon {mean_error_N(model):.4f} N, its model's mean error")
    search = PortraitSearch(reach, field) if choice is IN_PORTRAIT else build(choice, fields_mT, model, rises=rises)
    law = _law(scene, reach, field) if contact.slides else None
    memory = model.metadata.memory if scene.terms.memory else NO_MEMORY
    return Element(nominal, memory, field, reach, search, law, choice.solver in BESIDE_PLANS), choice


def sources_hash() -> str:
    """Return the SHA-256 of all sources that `plan` and `step` run."""
    digest = hashlib.sha256()
    for room in SOURCES:
        for path in sorted((ROOT / room).glob("**/*.py")):
            digest.update(f"{path.relative_to(ROOT).as_posix()} {path.stat().st_size}\n".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def platform_name() -> str:
    """Return what else the bits of a result depend on: processor, Python and NumPy."""
    return f"{platform.machine()}, Python {platform.python_version()}, NumPy {np.__version__}"


def _brake(scene: Scene) -> tuple[ElementContact, FieldOfGap, float]:
    """Return a brake's contact, the field over its gap, and its share of iron in percent."""
    fitted = insert(scene.insert.name)
    permeability, radius_mm = fitted.elastomer.relative_permeability, scene.insert.inner_radius_mm
    return Sliding(), FieldOfGap(PowerFieldLaw(), permeability, radius_mm * 1e-3), 100.0 * fitted.cip_fraction


def _pad(finger: Finger, model: ForceModel) -> tuple[ElementContact, FieldOfGap, float]:
    *_, (cip_percent, _) = model.feature_ranges
    return Pressing(finger.depth_mm), FieldOfGap(PowerFieldLaw(), REFERENCE_PERMEABILITY, PAD_RADIUS_M), cip_percent


def _law(scene: Scene, reach: Portrait, field: FieldOfGap) -> LawOfField:
    fitted, metres = scene.insert, 1e-3
    geometry = Geometry(
        fitted.inner_radius_mm * metres,
        fitted.outer_radius_mm * metres,
        fitted.thickness_mm * metres,
        fitted.roller_radius_mm * metres,
    )
    moments_Tm = PowerFieldLaw().radial_moment_Tm(np.array(reach.gap_mm))
    forces_N = brake_force_N(moments_Tm, insert(fitted.name).elastomer, geometry)
    scale = float(np.median(np.array(reach.force_N) / forces_N))
    return LawOfField((scale * forces_N).tolist(), [field.field_mT(gap_mm) for gap_mm in reach.gap_mm])


def _known_fields_mT(
    scene: Scene, model: ForceModel, contact: ElementContact, field: FieldOfGap
) -> tuple[tuple[float, float], bool]:
    """Return the fields that the gaps give and the model knows, and whether the force rises in them."""
    low_mT, high_mT = model.field_range_mT
    low_mT = max(low_mT, field.field_mT(scene.insert.gap_open_mm))
    high_mT = min(high_mT, field.field_mT(scene.insert.gap_closed_mm))
    if not low_mT < high_mT:
        raise DomainError("insert.model", f"trained on {model.field_range_mT} mT", "fields that the scene's gaps give")
    (_, most_mm), *_ = model.feature_ranges
    falling_mm_s = falling_at(model, (low_mT, high_mT), min(contact.displacement_mm, most_mm))
    if falling_mm_s is not None:
        raise DomainError(
            "insert.model",
            f"force that falls with the field at {falling_mm_s:.3g} mm/s",
            "a force that rises with the field: train it on more data, as `tormag-lab train-model --rising` checks",
        )
    if contact.slides:
        return (low_mT, high_mT), True
    depths_mm = np.linspace(PRESSED * contact.displacement_mm, most_mm, DEPTHS).tolist()
    return (low_mT, high_mT), all(falling_at(model, (low_mT, high_mT), depth) is None for depth in depths_mm)


def _stable_margins(config: Config) -> Margins:
    """Return the position loop's stability margins; raise ConfigError where they are too small."""
    stability = margins(config.motor, config.position, 1.0 / config.rates.control_hz)
    if not (stability.phase_margin_deg >= MIN_PHASE_MARGIN_DEG and stability.gain_margin_dB >= MIN_GAIN_MARGIN_DB):
        raise ConfigError(
            f"position: these gains leave a phase margin of {stability.phase_margin_deg:.2f} degrees and a gain margin "
            f"of {stability.gain_margin_dB:.2f} dB: allowed is at least {MIN_PHASE_MARGIN_DEG:g} and "
            f"{MIN_GAIN_MARGIN_DB:g}"
        )
    return stability


def _refuse_too_weak(config: Config, scene: Scene) -> None:
    motor, closed_mm = config.motor, scene.insert.gap_closed_mm
    least_mm_s2, mm_s2 = gap_speeds(config).sure_mm_s / TURNS_S, config.position.gap_acceleration_mm_s2
    if mm_s2 < least_mm_s2:
        raise ConfigError(
            f"position.gap_acceleration_mm_s2 = {mm_s2:g}: allowed is at least {ROUNDED_UP * least_mm_s2:.3g}, which "
            f"stops a closing gap within {TURNS_S:g} s"
        )
    needed_V = motor.coulomb_V + pull_V(motor.pull_V, closed_mm)
    max_V = config.position.duty_limit * motor.supply_V / 2.0
    if needed_V > max_V:
        raise ConfigError(
            f"motor: coulomb_V = {motor.coulomb_V:g} and pull_V = {motor.pull_V:g} take {needed_V:.2f} V to open the "
            f"gap from {closed_mm:g} mm: allowed is {max_V:g} V, half of position.duty_limit times motor.supply_V"
        )


def _out_of_reach(scene: Scene, reach: Portrait) -> Iterator[str]:
    """Yield which of the scene's greatest and standby forces the gaps do not reach."""
    # a lower least force is no error: no passive brake gives 0, and the limit F_MIN says so
    if not reach.min_N < scene.force.most_N <= reach.max_N:
        yield (
            f"force.most_N = {scene.force.most_N:g}: allowed is {reach.min_N:.2f}..{reach.max_N:.2f}, what model "
            f"{scene.insert.model} gives in these gaps"
        )
    standby_N, most_N = scene.force.standby_N, min(reach.min_N + STANDBY_N, scene.force.most_N)
    if standby_N is not UNSET and not reach.min_N < standby_N <= most_N:
        yield (
            f"force.standby_N = {standby_N:g}: allowed is above {reach.min_N:.3g}, what the open gap gives, to "
            f"{most_N:.3g}"
        )


def _slowed(config: Config, scene: Scene) -> Config:
    """Return the configuration with a gap no faster than the scene lets it move. Raises ConfigError."""
    most, asked_mm_s = gap_speeds(config), scene.insert.gap_speed_mm_s
    can_mm_s = max(most_closing_mm_s(config), most.opening_mm_s)
    if most.closing_mm_s > can_mm_s:
        raise ConfigError(
            f"position.closing_mm_s = {most.closing_mm_s:g}: allowed is at most {can_mm_s:.3g}, what the motors can"
        )
    if asked_mm_s is UNSET:
        return config
    slowed = {"gap_speed_mm_s": min(most.opening_mm_s, asked_mm_s), "closing_mm_s": min(most.closing_mm_s, asked_mm_s)}
    return msgspec.structs.replace(config, position=msgspec.structs.replace(config.position, **slowed))


def least_resolution_N(reach: Portrait, most_N: float) -> float:
    return max(SENSED_N, SETTLES_MM * reach.slope_at_N_mm(most_N))


def _too_fine(scene: Scene, reach: Portrait) -> Iterator[str]:
    least_N = least_resolution_N(reach, scene.force.most_N)
    if scene.force.resolution_N < least_N:
        yield (
            f"force.resolution_N = {scene.force.resolution_N:g}: allowed is at least {least_N:.2g}: the force sensor "
            f"has steps of {SENSED_N:g} N, and the gap settles to {1e3 * SETTLES_MM:.0f} um"
        )


def _unknown_hand(scene: Scene, model: ForceModel) -> list[str]:
    """Return which motions of the hand the model was not trained on."""
    depths_mm, rates_mm_s, *_ = model.feature_ranges
    handle, finger = scene.handle, scene.finger
    stated = [("handle.least_mm_s", handle.least_mm_s, rates_mm_s), ("handle.most_mm_s", handle.most_mm_s, rates_mm_s)]
    if finger is not UNSET:
        stated = [("finger.depth_mm", finger.depth_mm, depths_mm), ("finger.most_mm_s", finger.most_mm_s, rates_mm_s)]
    return [
        f"{key} = {value:g}: allowed is {least:.2g}..{most:.3g}, what model {scene.insert.model} was trained on"
        for key, value, (least, most) in stated
        if not least <= value <= most
    ]


def _missed(config: Config, scene: Scene, reach: Portrait, beside: Path) -> Missed | None:
    if scene.signal is None:
        return None
    # a scene whose greatest force is out of reach is asked for what is in reach
    low_N, most_N = max(scene.force.least_N, reach.min_N), min(scene.force.most_N, reach.max_N)
    bandwidth_hz = 0.0 if scene.signal.bandwidth_hz is UNSET else scene.signal.bandwidth_hz
    rate_hz = max(LOOKED_AT_HZ, math.ceil(LOOKS * bandwidth_hz))
    times_s, forces_N = asked(scene.signal, beside, (min(low_N, most_N), most_N), LOOKED_AT_S, rate_hz)
    return missed(reach, times_s.tolist(), forces_N.tolist(), config.position.gap_speed_mm_s)


def missed(shown: Portrait, times_s: list[float], forces_N: list[float], gap_speed_mm_s: float) -> Missed:
    """Return what ideal carriages without preview miss of forces at rising times."""
    at_N, squares, faster = forces_N[0], 0.0, 0
    for index in range(1, len(forces_N)):
        step_s, force_N = times_s[index] - times_s[index - 1], forces_N[index]
        most_N = shown.force_rate_N_s(at_N, gap_speed_mm_s) * step_s
        at_N += min(max(force_N - at_N, -most_N), most_N)
        squares += (force_N - at_N) ** 2
        faster += abs(force_N - forces_N[index - 1]) / step_s > shown.force_rate_N_s(force_N, gap_speed_mm_s)
    count = len(forces_N) - 1
    return Missed(math.sqrt(squares / count), faster / count)


def _too_fast(config: Config, scene: Scene, miss: Missed | None) -> Iterator[str]:
    """Yield by how much ideal carriages miss the signal, if beyond its tolerance."""
    if miss is not None and miss.rms_N > scene.force.tolerance_rms_N:
        yield (
            f"force.tolerance_rms_N = {scene.force.tolerance_rms_N:g}: allowed for its signal is at least "
            f"{ROUNDED_UP * miss.rms_N:.3g}: gaps of {config.position.gap_speed_mm_s:g} mm/s miss it by that, and "
            f"{miss.share:.0%} of the time it is faster"
        )


def _too_sudden(config: Config, scene: Scene, reach: Portrait) -> Iterator[str]:
    """Yield how fast an opening gap releases the force, where the scene forbids that."""
    # the weakest believable device makes a force at the least gap, where the gap's speed changes it most
    opening_mm_s, key = max(
        (2.0 * config.device.retract_mm_s, "device.retract_mm_s"),
        (config.position.gap_speed_mm_s, "position.gap_speed_mm_s"),
    )
    weakest = config.trim.least
    model_N = min(CEILING * scene.force.most_N / weakest, reach.max_N)
    lost_N_s = weakest * reach.force_rate_N_s(model_N, opening_mm_s)
    if lost_N_s > scene.force.most_release_N_s:
        yield (
            f"force.most_release_N_s = {scene.force.most_release_N_s:g}: allowed is at least {lost_N_s:.2f}: {key} "
            f"opens the gap by {opening_mm_s:g} mm/s, which at {weakest * model_N:.2g} N loses so much"
        )


def choose_solver(scene: Scene, *, rises: bool = True) -> Choice:
    wanted, searched = scene.solver, BY_NEWTON if rises else SEVERAL_BRANCHES
    if wanted.name != AUTO:
        return named(wanted.name, wanted.step_mT or None, wanted.neighbours or None)
    return searched if scene.terms.rate else IN_PORTRAIT
