"""`tormagctl scene`: which scenes there are, what one asks for, whether this configuration can give it, and how."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from tormagd.config import Config
from tormagd.ctl.outcome import CommandError, Exit, Outcome, answer_of, as_usage_error, folded, usage_error
from tormagd.scenes.measured import MeasuredScene, Measurements, OperatingPoint, Share, Tried, measured
from tormagd.scenes.scene import Force, Scene, load_scene, shipped_scenes
from tormagd_client.endpoints import ConfigError, Endpoints

if TYPE_CHECKING:  # listing scenes needs no sockets
    from tormagd_client.blocking import Client

LONGEST_S = 30.0
"The daemon's own check takes half a second."


def scene(
    action: str,
    name: str | None,
    share: float | None,
    tolerance_N: float | None,
    out: Path | None,
    config: Config,
    config_file: Path | None,
    endpoints: Endpoints,
    wait_s: float,
    plant: str | None = None,
    **recorded: Any,
) -> Outcome:
    """Do one of list, show, check, explain, new and use; without `name`, for the configuration's scene."""
    named = name or config.scene
    if action == "new":
        if name is None:
            raise usage_error("scene new: the file to write is missing", "tormagctl scene new FILE.toml")
        from tormagd.ctl.scene_new import Recorded, new_scene

        return new_scene(Path(name), Recorded(**recorded, tolerance_N=tolerance_N), config_file, plant)
    if plant is not None and action != "check":
        raise usage_error("--plant: allowed only for scene check and new", "tormagctl scene check NAME --plant FILE")
    if unused := [key for key, value in recorded.items() if value is not None]:
        raise usage_error(
            f"--{unused[0].removesuffix('_N')}: allowed only for scene new", "tormagctl scene new FILE.toml"
        )
    if share is not None or tolerance_N is not None or out is not None:
        from tormagd.ctl.scene_served import serve_scene

        return serve_scene(action, named, share, tolerance_N, out)
    match action:
        case "list":
            return list_scenes()
        case "show":
            return show_scene(named)
        case "check":
            return check_scene(named, config_file, plant)
        case "explain":
            return explain_scene(named, config_file)
    from tormagd_client.blocking import Client

    with Client(endpoints, wait_s) as client:
        return use_scene(client, named)


def use_scene(client: "Client", name: str) -> Outcome:
    from tormagd.ctl.operate import statuses

    scene = str(Path(name).absolute()) if name not in shipped_scenes() and Path(name).exists() else name
    client.request("use-scene", scene=scene)
    changes = ((state, state.scene_change) for _, state in statuses(client, LONGEST_S))
    state, change = next(((state, each) for state, each in changes if each and each.is_over), (None, None))
    if state is None or change is None:
        raise CommandError(Exit.REFUSED, "timeout", f"{scene} is not ready after {LONGEST_S:g} s", "tormagctl status")
    if change.error is not None:
        raise CommandError(Exit.REFUSED, change.error.code, change.error.cause, change.error.remedy)
    result = {"scene": state.scene, "fingerprint": state.scene_fingerprint, "is_homed": state.is_homed}
    return Outcome(
        result, f"scene {state.scene} runs until the daemon is started anew; nothing moves before tormagctl arm"
    )


def list_scenes() -> Outcome:
    scenes = [load_scene(name) for name in shipped_scenes()]
    width = max(len(scene.name) for scene in scenes)
    return Outcome(
        {"scenes": [{"name": scene.name, "description": scene.description} for scene in scenes]},
        folded("\n".join(f"{scene.name:<{width}}  {scene.description}" for scene in scenes)),
    )


def show_scene(name: str) -> Outcome:
    """Return everything a scene states, defaults included, as TOML."""
    stated = msgspec.to_builtins(loaded(name))
    tables = {key: value for key, value in stated.items() if value is not None}
    return Outcome(tables, as_toml(tables))


def as_toml(tables: dict[str, Any]) -> str:
    lines = [_line(key, value) for key, value in tables.items() if not isinstance(value, dict)]
    for title, table in tables.items():
        if isinstance(table, dict):
            lines += ["", f"[{title}]", *(_line(key, value) for key, value in table.items())]
    return "\n".join(lines)


def torque_range(scene: Scene) -> str:
    """Return the scene's forces and resolution as torques at the handle's shaft, mNm."""
    radius_mm, force = scene.roller_radius_mm, scene.force
    if radius_mm is None:
        return ""
    return (
        f", {force.least_N * radius_mm:g}..{force.most_N * radius_mm:g} mNm in {force.resolution_N * radius_mm:g} mNm"
    )


def _line(key: str, value: object) -> str:
    # numbers and texts read the same in JSON and TOML
    return f"{key} = {msgspec.json.encode(value).decode()}"


def check_scene(name: str, config: Path | None, plant: str | None = None) -> Outcome:
    """Say whether a daemon with this configuration takes the scene, how it serves it, and at what cost."""
    scene = loaded(name)
    derived = _derived(name, config)
    file = measured()
    share = file.share(way_of(derived)) if not derived["terms_out"] else None
    if share is not None and share.daemon > scene.budget.core_share:
        raise CommandError(
            Exit.REFUSED,
            "budget",
            f"scene {scene.name}: a daemon takes {share.daemon:.1%} of a processor for it: allowed is "
            f"budget.core_share = {scene.budget.core_share:g}",
            "tormagctl scene explain says what other rates and searches take",
        )
    given = {}
    if plant is not None:
        from tormagd.ctl.scene_plant import on_plant

        given = on_plant(scene, name, plant)
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
        *(
            [
                f"plant      {given['plant']} gives {given['least_N']:.2f}..{given['most_N']:.2f} N; its carriages "
                f"at best miss {1e3 * given['foresight_rms_N']:.1f} mN"
            ]
            if given
            else []
        ),
        f"served     {way_of(derived)}",
        "cost       not measured of these rates, search and terms"
        if share is None
        else f"cost       {share.daemon:.1%} of a processor for the daemon, {scene.budget.core_share:.0%} are allowed",
    ]
    result = {
        "scene": scene.name,
        "core_share": share and share.daemon,
        "core_share_allowed": scene.budget.core_share,
        "on_plant": given or None,
    } | derived
    return Outcome(result, folded("\n".join(lines)))


def _waiting(force: Force, approaches_s: list[tuple[float, float]]) -> list[str]:
    """Return a line on how soon a force comes from where the brake waits."""
    if not approaches_s:
        return []
    (wait_N, now_s), *nearer = approaches_s
    others = ", ".join(f"{standby_N:.2f} N {later_s:.2f} s" for standby_N, later_s in nearer)
    return [
        f"waiting    at {wait_N:.2f} N: {(wait_N + force.most_N) / 2.0:.2f} N come after {now_s:.2f} s; with "
        f"force.standby_N, which is felt as drag: {others}"
    ]


def explain_scene(name: str, config: Path | None) -> Outcome:
    """Show every measured way to serve a scene, the chosen one, and how well it served other signals."""
    file = measured()
    found = measured_as(loaded(name), file)
    derived = _derived(name, config)
    tolerance_N = found.tolerance_N
    runs = way_of(derived)
    lines = [
        f"{found.name}: tolerance {1e3 * tolerance_N:g} mN RMS",
        "",
        f"{'way':28} {'samples 1 to 3, mN':>22} {'of a processor':>15}",
        *(_tried(each, file.share(each.way), found.chosen, runs) for each in found.tried),
        "",
        *([] if found.is_met else ["NOT MET: the usual way itself is over the tolerance", ""]),
        f"{'chosen, judged':28} {'worst device':>14} {'chosen':>10} {'usual':>10}",
        *(
            f"{item.signal + ('' if item.learning else ', frozen'):28} {item.device:>14} {1e3 * item.rms_N:7.1f} mN "
            f"{1e3 * item.usual_N:7.1f} mN"
            for item in found.judged
        ),
        "",
        f"Shares: the daemon's processes, live on the simulated device, beside a machine_us of {file.machine_us:g}.",
    ]
    result = msgspec.to_builtins(found) | {"shares": msgspec.to_builtins(file.shares), "derived": derived}
    return Outcome(result, folded("\n".join(lines)))


def _tried(tried: Tried, share: Share | None, chosen: OperatingPoint, runs: OperatingPoint) -> str:
    """Return one way's row: errors on three samples, share of a processor, whether chosen."""
    marks = [word for way, word in ((chosen, "chosen"), (runs, "runs here")) if way == tried.way]
    errors = " ".join(f"{1e3 * error_N:6.1f}" for error_N in tried.rms_N)
    taken = "not measured" if share is None else f"{share.daemon:.1%}"
    return f"{tried.way!s:28} {errors:>22} {taken:>15}  {', '.join(marks)}".rstrip()


def way_of(derived: dict[str, Any]) -> OperatingPoint:
    return OperatingPoint(derived["control_hz"], derived["inference_hz"], derived["solver"]["solver"])


def measured_as(scene: Scene, file: Measurements) -> MeasuredScene:
    """Return what was measured of a scene that asks for the same, under whatever name."""
    found = file.scene(scene.fingerprint)
    if found is None:
        raise CommandError(
            Exit.REFUSED,
            "not_measured",
            f"scene {scene.name} was not measured as it is now",
            "tormagctl guide scene says how that is done, in some minutes",
        )
    return found


def loaded(name: str) -> Scene:
    with as_usage_error(ConfigError, hint="tormagctl scene list shows the shipped ones"):
        return load_scene(name)


def _derived(name: str, config: Path | None) -> dict[str, Any]:
    """Run the daemon's own check in a process, and return what it derives."""
    arguments = ["--check", "--scene", name, *([] if config is None else ["--config", str(config)])]
    try:
        derived: dict[str, Any] = msgspec.json.decode(answer_of("tormagd.daemon.main", arguments, LONGEST_S))["derived"]
    except TimeoutError as error:
        raise CommandError(
            Exit.REFUSED, "not_checked", f"scene {name!r} could not be checked: {error}", "try it again"
        ) from error
    except ChildProcessError as error:
        raise CommandError(
            Exit.REFUSED,
            "refused",
            str(error).removeprefix("tormagd: "),
            "tormagctl guide scenes says what each key asks of the device",
        ) from error
    return derived
