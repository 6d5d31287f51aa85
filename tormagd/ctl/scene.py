"""`tormagctl scene`: which scenes there are, what one asks for, and whether, how and at what cost a daemon serves it.

With `--share` or `--tolerance` a check chooses how a scene is served: at a price, or within an error.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import UNSET

from tormagd.config import Config
from tormagd.ctl.outcome import NEW_FILE, CommandError, Exit, Outcome, answer_of, as_usage_error, folded, usage_error
from tormagd.ground.files import new_file
from tormagd.ground.machine_loop import machine_us
from tormagd.scenes.measured import MeasuredScene, OperatingPoint, Served, measured, own_way
from tormagd.scenes.scene import Force, Scene, load_scene, scene_path, shipped_scenes
from tormagd_client.endpoints import ConfigError

if TYPE_CHECKING:  # listing scenes needs no sockets
    from tormagd_client.blocking import Client

LONGEST_S = 30.0
"The daemon's own check takes half a second."


def list_scenes() -> Outcome:
    scenes = [load_scene(name) for name in shipped_scenes()]
    width = max(len(scene.name) for scene in scenes)
    return Outcome(
        {"scenes": [{"name": scene.name, "description": scene.description} for scene in scenes]},
        folded("\n".join(f"{scene.name:<{width}}  {scene.description}" for scene in scenes)),
    )


def show_scene(config: Config, name: str | None) -> Outcome:
    """Return everything a scene states, defaults included, as TOML."""
    stated = msgspec.to_builtins(loaded(name or config.scene))
    tables = {key: value for key, value in stated.items() if value is not None}
    return Outcome(tables, as_toml(tables))


def check(
    config: Config,
    config_file: Path | None,
    name: str | None,
    share: float | None,
    tolerance_N: float | None,
    out: Path | None,
) -> Outcome:
    """Check a scene; with `share` or `tolerance_N` choose how it is served."""
    named = name or config.scene
    if share is None and tolerance_N is None and out is None:
        return check_scene(named, config_file)
    return serve_scene(named, share, tolerance_N, out, config.device.backend)


def check_scene(name: str, config: Path | None) -> Outcome:
    """Say whether a daemon with this configuration takes the scene, how it serves it, and at what cost."""
    scene = loaded(name)
    derived = derived_of(name, config)
    sent_hz = UNSET if scene.signal is None else scene.signal.setpoint_hz
    share, plans_hz = _price(name, scene, derived, 0.0 if sent_hz is UNSET else sent_hz)
    if share is not None and share > scene.budget.core_share:
        raise CommandError(
            Exit.REFUSED,
            "budget",
            f"scene {scene.name}: a daemon takes {share:.1%} of a processor here for it: allowed is "
            f"budget.core_share = {scene.budget.core_share:g}",
            "tormagctl scene explain says what other rates and searches take",
        )
    force, least_N = scene.force, derived["least_N"]
    lines = [
        f"{scene.name}: taken",
        f"forces     {force.least_N:g}..{force.most_N:g} N of the device's {least_N:.2f}..{derived['most_N']:.2f}"
        + _torque_range(scene),
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
        *([] if sent_hz is UNSET else [f"           its publisher sends {sent_hz:g} times a second"]),
        *_waiting(force, derived["approaches_s"]),
        f"served     {way_of(scene, derived)}",
        "cost       not measured of these rates, search and terms"
        if share is None
        else f"cost       {share:.1%} of a processor of this machine for {plans_hz:g} plans a second, "
        f"{scene.budget.core_share:.0%} are allowed",
    ]
    result = {
        "scene": scene.name,
        "core_share": share,
        "core_share_allowed": scene.budget.core_share,
    } | derived
    return Outcome(result, folded("\n".join(lines)))


def _price(name: str, scene: Scene, derived: dict[str, Any], sent_hz: float) -> tuple[float | None, float]:
    """Return the share of this machine's processor, if it was measured, and the plans a second that it is for."""
    way = way_of(scene, derived)
    plans_hz = max(way.inference_hz, sent_hz if derived["plan_every_setpoint"] else 0.0)
    found = None if derived["terms_out"] else measured(scene, name)
    return None if found is None else found.share_of(way, machine_us(), plans_hz, derived["backend"]), plans_hz


def _torque_range(scene: Scene) -> str:
    """Return the scene's forces and resolution as torques at the handle's shaft, mNm."""
    radius_mm, force = scene.roller_radius_mm, scene.force
    if radius_mm is None:
        return ""
    return (
        f", {force.least_N * radius_mm:g}..{force.most_N * radius_mm:g} mNm in {force.resolution_N * radius_mm:g} mNm"
    )


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


def derived_of(name: str, config: Path | None) -> dict[str, Any]:
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


def way_of(scene: Scene, derived: dict[str, Any]) -> OperatingPoint:
    return own_way(scene, derived["control_hz"], derived["inference_hz"], derived["solver"]["solver"])


def measured_as(name: str, scene: Scene) -> MeasuredScene:
    """Return what was measured of a scene that asks for the same, under whatever name."""
    found = measured(scene, name)
    if found is None:
        raise CommandError(
            Exit.REFUSED,
            "not_measured",
            f"scene {scene.name} was not measured as it is now",
            f"tormagctl scene measure {name}: about three minutes",
        )
    return found


def loaded(name: str) -> Scene:
    with as_usage_error(ConfigError, hint="tormagctl scene list shows the shipped ones"):
        return load_scene(name)


def as_toml(tables: dict[str, Any]) -> str:
    lines = [_line(key, value) for key, value in tables.items() if not isinstance(value, dict)]
    for title, table in tables.items():
        if isinstance(table, dict):
            lines += ["", f"[{title}]", *(_line(key, value) for key, value in table.items())]
    return "\n".join(lines)


def _line(key: str, value: object) -> str:
    # numbers and texts read the same in JSON and TOML
    return f"{key} = {msgspec.json.encode(value).decode()}"


ALIKE = 0.1
"Errors that differ by less than this share are alike: so do two runs of one way."


Ways = Mapping[OperatingPoint, tuple[float, float]]
"Measured ways to serve a scene, each with its share of a processor and its worst RMS error."


def serve_scene(name: str, share: float | None, tolerance_N: float | None, out: Path | None, backend: str) -> Outcome:
    """Choose the most exact way within `share` of a processor, or the cheapest within an error."""
    if (share is None) == (tolerance_N is None):
        raise usage_error(
            "--share, --tolerance and --out choose how a scene is served",
            "tormagctl scene check NAME with one of --share S and --tolerance N, and --out FILE.toml to write it",
        )
    scene = loaded(name)
    found, machine = measured_as(name, scene), machine_us()
    ways = {
        each.way: (found.share_here(each, machine, backend), each.worst_N) for each in found.offered(scene.bandwidth)
    }
    way = _best(ways, share, tolerance_N or 0.0)
    daemon_share, rms_N = ways[way]
    text = (
        f"{scene.name}: {way}: {1e3 * rms_N:.1f} mN RMS in the worst situation, "
        f"the daemon takes {daemon_share:.1%} of a processor of this machine"
    )
    if out is not None:
        write_scene(name, way, out)
        text += f"\n{out} is written: tormagd --scene {out}"
    result = {"scene": scene.name, "way": msgspec.to_builtins(way), "rms_N": rms_N}
    return Outcome(result | {"daemon_share": daemon_share, "file": None if out is None else str(out)}, text)


def _best(ways: Ways, share: float | None, tolerance_N: float) -> OperatingPoint:
    """Return the most exact of `ways` within `share`, or without one the cheapest within `tolerance_N`."""
    bounds = ("--tolerance", 1, tolerance_N, "N") if share is None else ("--share", 0, share, "of a processor")
    asked, bounded, most, unit = bounds
    fits = [way for way, figures in ways.items() if figures[bounded] <= most]
    if not fits:
        least = min(figures[bounded] for figures in ways.values())
        raise CommandError(
            Exit.REFUSED,
            "no_way",
            f"{asked} = {most:g}: allowed is at least {least:.3g} {unit}",
            "tormagctl scene explain shows every way; not offered is one that is worse than the usual one",
        )
    least_N = min(ways[way][1] for way in fits)
    alike = [way for way in fits if share is None or ways[way][1] <= (1.0 + ALIKE) * least_N]
    return min(alike, key=lambda way: (len(way.given), ways[way][0]))


def write_scene(name: str, way: OperatingPoint, out: Path) -> None:
    """Write the scene as this way serves it to the new file `out`; relative paths are adapted."""
    path = scene_path(name)
    tables: dict[str, Any] = msgspec.to_builtins(load_scene(name))
    tables = {key: value for key, value in tables.items() if value is not None}
    if (signal := tables.get("signal")) and signal["file"]:
        signal["file"] = os.path.relpath(path.parent / signal["file"], out.parent)
    if (path.parent / tables["insert"]["model"]).is_file():
        tables["insert"]["model"] = os.path.relpath(path.parent / tables["insert"]["model"], out.parent)
    tables["bandwidth"] = {"control_hz": way.control_hz, "inference_hz": way.inference_hz}
    tables["solver"] = {"name": way.search}
    tables["force"] |= {"standby_N": way.standby_N} if way.standby_N else {}
    tables["insert"] |= {"gap_speed_mm_s": way.gap_speed_mm_s} if way.gap_speed_mm_s else {}
    tables |= {"signal": signal | {"is_known_ahead": way.ahead_ms > 0.0}} if signal else {}
    with as_usage_error(OSError, hint=f"name another: {NEW_FILE}"), new_file(out):
        out.write_text(as_toml(tables) + "\n", encoding="utf-8")


def explain_scene(config: Config, config_file: Path | None, name: str | None) -> Outcome:
    """Show every measured way to serve a scene, the chosen one, and how well it does on a device that chose nothing."""
    named = name or config.scene
    scene, derived = loaded(named), derived_of(named, config_file)
    found = measured_as(named, scene)
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
