"""`tormagctl scene`: which scenes there are, what one asks for, whether this configuration can give it, and how."""

from pathlib import Path
from typing import Any

import msgspec

from tormagd.config import Config
from tormagd.ctl.outcome import CommandError, Exit, Outcome, as_usage_error, usage_error
from tormagd.ctl.process import answer_of
from tormagd.scenes.measured import Measured, MeasuredScene, is_met, measured, on_first, required
from tormagd.scenes.scene import Force, Scene, load_scene, shipped_scenes
from tormagd_client.endpoints import ConfigError

LONGEST_S = 30.0
"Of the daemon's own check, which takes half a second."
TOLERANCES = (0.5, 1.0, 2.0)
"Times the scene's own, for which the terms are stated."


def scene(action: str, name: str | None, force: Path | None, config: Config, config_file: Path | None) -> Outcome:
    """One of the five; without a name, of the configuration's scene."""
    named = name or config.scene
    match action:
        case "list":
            return list_scenes()
        case "show":
            return show_scene(named)
        case "check":
            return check_scene(named, config_file)
        case "explain":
            return explain_scene(named, config_file)
    if name is None:
        raise usage_error("scene new: the file to write is missing", "tormagctl scene new FILE.toml")
    from tormagd.ctl.scene_new import new_scene

    return new_scene(Path(name), force, config_file)


def list_scenes() -> Outcome:
    """The shipped scenes with their descriptions."""
    scenes = [load_scene(name) for name in shipped_scenes()]
    width = max(len(scene.name) for scene in scenes)
    return Outcome(
        {"scenes": [{"name": scene.name, "description": scene.description} for scene in scenes]},
        "\n".join(f"{scene.name:<{width}}  {scene.description}" for scene in scenes),
    )


def show_scene(name: str) -> Outcome:
    """Everything one scene states, defaults included. Raises CommandError (USAGE) for an unknown or faulty one."""
    stated = msgspec.to_builtins(_loaded(name))
    tables = {key: value for key, value in stated.items() if value is not None}
    return Outcome(tables, as_toml(tables))


def as_toml(tables: dict[str, Any]) -> str:
    """The text of a scene file with these keys and tables."""
    lines = [_line(key, value) for key, value in tables.items() if not isinstance(value, dict)]
    for title, table in tables.items():
        if isinstance(table, dict):
            lines += ["", f"[{title}]", *(_line(key, value) for key, value in table.items())]
    return "\n".join(lines)


def torque_range(scene: Scene) -> str:
    """The forces as torques at the handle's shaft; nothing for a pad."""
    radius_mm, force = scene.roller_radius_mm, scene.force
    if radius_mm is None:
        return ""
    return (
        f", {force.least_N * radius_mm:g}..{force.most_N * radius_mm:g} mNm in {force.resolution_N * radius_mm:g} mNm"
    )


def _line(key: str, value: object) -> str:
    # a number or a text reads the same in JSON and TOML
    return f"{key} = {msgspec.json.encode(value).decode()}"


def check_scene(name: str, config: Path | None) -> Outcome:
    """Whether a daemon with this configuration takes the scene, what its device gives of it, and whether its cost is
    within its budget. Raises CommandError where it does not, and for a faulty scene."""
    derived = _derived(name, config)
    scene = _loaded(name)
    known = _known(scene)
    share = None if known is None else _core_share(known[1], derived)
    if share is not None and share > scene.budget.core_share:
        raise CommandError(
            Exit.REFUSED,
            "budget",
            f"scene {scene.name}: its steps and plans take {share:.1%} of a processor: allowed is "
            f"budget.core_share = {scene.budget.core_share:g}",
            "leave terms out, or lower the rates: tormagctl scene explain says what that costs",
        )
    force, signal, least_N = scene.force, scene.signal, derived["least_N"]
    lines = [
        f"{scene.name}: taken",
        f"forces     {force.least_N:g}..{force.most_N:g} N of the device's {least_N:.2f}..{derived['most_N']:.2f}"
        + torque_range(scene),
        f"resolution {force.resolution_N:g} N, the device's is {derived['least_resolution_N']:.2g}",
        *(
            [f"           below {least_N:.2f} N it gets that: a passive device has a least force (limit F_MIN)"]
            if force.least_N < least_N
            else []
        ),
        "signal     not stated: nothing is known of how fast the force changes"
        if derived["missed_rms_N"] is None
        else f"signal     the gap's speed alone misses {1e3 * derived['missed_rms_N']:.1f} mN of a tolerance of "
        f"{1e3 * force.tolerance_rms_N:g}, {derived['missed_share']:.1%} of the time is faster",
        *(
            [f"           its publisher sends {signal.setpoint_hz:g} times a second"]
            if signal is not None and signal.setpoint_hz is not msgspec.UNSET
            else []
        ),
        *_waiting(force, derived["approaches_s"]),
        "cost       not measured: docs/guides/scene.md says how"
        if share is None
        else f"cost       {share:.1%} of a processor, {scene.budget.core_share:.0%} are allowed",
    ]
    result = {"scene": scene.name, "core_share": share, "core_share_allowed": scene.budget.core_share} | derived
    return Outcome(result, "\n".join(lines))


def _waiting(force: Force, approaches_s: list[tuple[float, float]]) -> list[str]:
    """How soon a force comes from where the brake waits, and from nearer."""
    if not approaches_s:
        return []
    (wait_N, now_s), *nearer = approaches_s
    others = ", ".join(f"{standby_N:.2f} N {later_s:.2f} s" for standby_N, later_s in nearer)
    return [
        f"waiting    at {wait_N:.2f} N: {(wait_N + force.most_N) / 2.0:.2f} N come after {now_s:.2f} s; with "
        f"force.standby_N, which is felt as drag: {others}"
    ]


def explain_scene(name: str, config: Path | None) -> Outcome:
    """The decision on one scene, as it was measured, as a table. Raises CommandError where nothing was measured, for a
    scene that the daemon refuses, and for a faulty one."""
    derived = _derived(name, config)
    scene = _loaded(name)
    known = _known(scene)
    if known is None:
        raise CommandError(
            Exit.REFUSED,
            "not_measured",
            f"scene {scene.name} was not measured as it is now",
            "docs/guides/scene.md says how that is done, in some minutes",
        )
    file, found = known
    tolerance_N = found.tolerance_N
    needed = {factor: required(found.terms, factor * tolerance_N, file.share) for factor in TOLERANCES}
    out, usual = set(derived["terms_out"]), found.rates[0]
    solver = derived["solver"]
    width = max(len(item.term) for item in found.terms)
    lines = [
        f"{scene.name}: {scene.description}",
        f"tolerance  {1e3 * tolerance_N:g} mN rms; a term is required that adds more than {file.share:.0%} of it",
        f"search     {solver['solver']} ({solver['reason']})",
        f"cost       {found.cost_full_us_s / 1e4:.2f}% of a processor with every term at "
        f"{usual.control_hz} / {usual.inference_hz} Hz, "
        f"{found.cost_us_s / 1e4:.2f}% with those that are required at {found.control_hz} / {found.inference_hz} Hz "
        f"({file.build}, machine_us {file.machine_us:g})",
        "",
        f"{'term':{width}} runs   required  added, frozen  added, learning      saved    at half  at twice the "
        "tolerance",
    ]
    for item in found.terms:
        at_half, at_twice = ("in" if item.term in needed[factor] else "out" for factor in (0.5, 2.0))
        lines.append(
            f"{item.term:{width}} {'out' if item.term in out else 'in':6s} "
            f"{'out' if item.term in found.left_out else 'in':8s} "
            f"{1e3 * item.frozen_added_N:11.1f} mN {1e3 * item.learning_added_N:13.1f} mN "
            f"{found.saved_us_s(item) / 1e4:8.2f}% {at_half:>10s} {at_twice:>9s}"
        )
    back = [item.term for item in found.terms if item.term not in needed[1.0] and item.term not in found.left_out]
    lines += [
        *([f"{', '.join(back)}: not required alone, but with the others out"] if back else []),
        "",
        "true force, RMS    every term   required ones",
        *(
            f"{it.plant} {'learning' if it.is_learning else 'frozen':9s} {1e3 * it.full_N:7.1f} mN "
            f"{1e3 * it.chosen_N:10.1f} mN"
            for it in found.judged
        ),
        *([] if is_met(found.judged, tolerance_N) else ["NOT MET: the full model itself is over the tolerance"]),
        "",
        "every term  control  inference  RMS on sample 1",
        *(
            f"            {at.control_hz:4d} Hz  {at.inference_hz:6d} Hz  {1e3 * on_first(at.judged).chosen_N:7.1f} mN"
            f"{'  chosen' if at is found.at_chosen else ''}"
            for at in found.rates
        ),
        "",
        "search named     RMS on sample 1    core share",
        *(
            f"{named.search:15s} {1e3 * named.rms_N:12.1f} mN  {found.us_s(named.cost) / 1e4:10.2f}%"
            for named in found.searches
        ),
    ]
    result = msgspec.to_builtins(found) | {
        "derived": derived,
        "required": {f"{factor:g}": names for factor, names in needed.items()},
    }
    return Outcome(result, "\n".join(lines))


def _core_share(found: MeasuredScene, derived: dict[str, Any]) -> float:
    """Of the terms and at the rates that the daemon runs; a set of terms that was not measured counts as all. A plan is
    dearest at slow rates: at rates that were not measured the share is at most this."""
    hz = derived["control_hz"], derived["inference_hz"]
    if tuple(derived["terms_out"]) == found.left_out:
        cost = found.chosen
    else:
        cost = next((at.cost for at in found.rates if at.hz == hz), found.at_chosen.cost)
    return 1e-6 * cost.us_s(*hz)


def _known(scene: Scene) -> tuple[Measured, MeasuredScene] | None:
    file = measured()
    return next(((file, found) for found in file.scenes if found.fingerprint == scene.fingerprint), None)


def _loaded(name: str) -> Scene:
    with as_usage_error(ConfigError, hint="tormagctl scene list shows the shipped ones"):
        return load_scene(name)


def _derived(name: str, config: Path | None) -> dict[str, Any]:
    """What the daemon's own check says of the scene. It loads what no command of this tool does: model and solvers."""
    arguments = ["--check", "--scene", name, *([] if config is None else ["--config", str(config)])]
    try:
        derived: dict[str, Any] = msgspec.json.decode(answer_of("tormagd.daemon.main", arguments, LONGEST_S))["derived"]
    except TimeoutError as error:
        raise CommandError(Exit.REFUSED, "not_checked", str(error), "try it again") from error
    except ChildProcessError as error:
        raise CommandError(
            Exit.REFUSED,
            "refused",
            str(error).removeprefix("tormagd: "),
            "docs/scenes.md says what each key asks of the device",
        ) from error
    return derived
