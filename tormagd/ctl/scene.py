"""`tormagctl scene`: which scenes there are, what one asks for, whether this configuration can give it, and how."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from tormagd.config import Config
from tormagd.ctl.outcome import CommandError, Exit, Outcome, folded, usage_error
from tormagd.ctl.scene_check import LONGEST_S, as_toml, check_scene, derived_of, loaded, measured_as, way_of
from tormagd.scenes.measured import OperatingPoint, Share, Tried, measured
from tormagd.scenes.scene import load_scene, shipped_scenes
from tormagd_client.endpoints import Endpoints

if TYPE_CHECKING:  # listing scenes needs no sockets
    from tormagd_client.blocking import Client


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
    **recorded: Any,
) -> Outcome:
    """Do one of list, show, check, explain, new and use; without `name`, for the configuration's scene."""
    named = name or config.scene
    if action == "new":
        if name is None:
            raise usage_error("scene new: the file to write is missing", "tormagctl scene new FILE.toml")
        from tormagd.ctl.scene_new import Recorded, new_scene

        return new_scene(Path(name), Recorded(**recorded, tolerance_N=tolerance_N), config_file)
    if unused := [key for key, value in recorded.items() if value is not None]:
        raise usage_error(
            f"--{unused[0].removesuffix('_N').replace('_', '-')}: allowed only for scene new",
            "tormagctl scene new FILE.toml",
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
            return check_scene(named, config_file)
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


def explain_scene(name: str, config: Path | None) -> Outcome:
    """Show every measured way to serve a scene, the chosen one, and how well it served other signals."""
    file = measured()
    found = measured_as(loaded(name), file)
    derived = derived_of(name, config)
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
