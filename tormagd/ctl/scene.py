"""`tormagctl scene`: which scenes there are, what one asks for, whether this configuration can give it, and how."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from tormagd.config import Config
from tormagd.ctl.outcome import CommandError, Exit, Outcome, folded, usage_error
from tormagd.ctl.scene_check import (
    LONGEST_S,
    as_toml,
    check_scene,
    derived_of,
    loaded,
    measured_as,
    serve_scene,
    way_of,
)
from tormagd.ground.machine_loop import machine_us
from tormagd.scenes.measured import Served
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
    """Do one of list, show, check, explain, measure, new and use; without `name`, for the configuration's scene."""
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
        return serve_scene(action, named, share, tolerance_N, out, config.device.backend)
    match action:
        case "list" if name is None:
            return list_scenes()
        case "list":
            raise usage_error(f"scene list {name}: allowed is no name", f"tormagctl scene show {name}")
        case "show":
            return show_scene(named)
        case "check":
            return check_scene(named, config_file)
        case "explain":
            return explain_scene(named, config_file)
        case "measure":
            from tormagd.ctl.scene_measure import measure_scene

            return measure_scene(named)
    from tormagd_client.blocking import Client

    with Client(endpoints, wait_s) as client:
        return use_scene(client, named)


def use_scene(client: "Client", name: str) -> Outcome:
    from tormagd.ctl.operate import statuses

    scene = str(Path(name).absolute()) if name not in shipped_scenes() and os.path.lexists(name) else name
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
    """Show every measured way to serve a scene, the chosen one, and how well it does on a device that chose nothing."""
    scene, derived = loaded(name), derived_of(name, config)
    found = measured_as(name, scene)
    runs, machine, backend = way_of(scene, derived), machine_us(), derived["backend"]
    offered, chosen = found.offered(scene.bandwidth), found.chosen

    def price(each: Served) -> float:
        return found.share_here(each, machine, backend)

    def row(each: Served, is_marked: bool = True) -> str:
        errors = " ".join(f"{1e3 * error_N:8.1f}" for error_N in each.rms_N.values())
        marks = {"chosen": each is chosen, "runs here": each.way == runs, "not offered": each not in offered}
        said = ", ".join(word for word, holds in marks.items() if holds and is_marked)
        return f"{each.way!s:{width}} {errors} {price(each):7.1%}  {said}".rstrip()

    width = max(len(str(each.way)) for each in (*found.served, *found.more))
    lines = [
        f"{scene.name}: tolerance {1e3 * found.tolerance_N:g} mN RMS",
        "",
        f"{'mN RMS':{width}} {' '.join(f'{each:>8}' for each in found.usual.rms_N)} {'share':>7}",
        *map(row, found.served),
        *(["", "one thing more:", *map(row, found.more)] if found.more else []),
        "",
        f"on {found.judged[0].device}, which chose nothing:",
        *(row(each, is_marked=False) for each in found.judged),
        "",
        *([] if found.is_met else ["NOT MET: the usual way itself is over the tolerance\n"]),
        *(
            [f"The scene states {runs}; {chosen.way} serves it for {price(chosen):.1%}.\n"]
            if runs != chosen.way
            else []
        ),
        "Live beside simulated devices: the true force's error in each situation, and what the daemon's processes take",
        f"of a processor by {backend}, scaled from a machine_us of {found.machine_us:g} to {machine:.0f} here.",
    ]
    return Outcome(msgspec.to_builtins(found) | {"here_us": machine, "derived": derived}, folded("\n".join(lines)))
