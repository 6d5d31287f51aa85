"""`tormagctl scene check NAME --share | --tolerance`: how a scene is served at a price, or within an error."""

import os
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from tormagd.ctl.outcome import CommandError, Exit, Outcome, as_usage_error, usage_error
from tormagd.ctl.scene_check import NEW_FILE, as_toml, loaded, measured_as
from tormagd.ground.files import new_file
from tormagd.ground.machine_loop import machine_us
from tormagd.scenes.measured import OperatingPoint
from tormagd.scenes.scene import load_scene, scene_path

ALIKE = 0.1
"Errors that differ by less than this share are alike: so do two runs of one way."


class Served(NamedTuple):
    """A measured way to serve a scene: its share of a processor and worst RMS error."""

    way: OperatingPoint
    figures: tuple[float, float]


def serve_scene(
    action: str, name: str, share: float | None, tolerance_N: float | None, out: Path | None, backend: str
) -> Outcome:
    """Choose the most exact way within `share` of a processor, or the cheapest within an error."""
    if action != "check" or (share is None) == (tolerance_N is None):
        raise usage_error(
            "--share, --tolerance and --out choose how a scene is served",
            "tormagctl scene check NAME with one of --share S and --tolerance N, and --out FILE.toml to write it",
        )
    scene = loaded(name)
    found, machine = measured_as(name, scene), machine_us()
    ways = [
        Served(each.way, (found.share_here(each, machine, backend), each.worst_N))
        for each in found.offered(scene.bandwidth)
    ]
    way, (daemon_share, rms_N) = _best(ways, share, tolerance_N or 0.0)
    text = (
        f"{scene.name}: {way}: {1e3 * rms_N:.1f} mN RMS in the worst situation, "
        f"the daemon takes {daemon_share:.1%} of a processor of this machine"
    )
    if out is not None:
        write_scene(name, way, out)
        text += f"\n{out} is written: tormagd --scene {out}"
    result = {"scene": scene.name, "way": msgspec.to_builtins(way), "rms_N": rms_N}
    return Outcome(result | {"daemon_share": daemon_share, "file": None if out is None else str(out)}, text)


def _best(ways: list[Served], share: float | None, tolerance_N: float) -> Served:
    """Return the most exact of `ways` within `share`, or without one the cheapest within `tolerance_N`."""
    bounds = ("--tolerance", 1, tolerance_N, "N") if share is None else ("--share", 0, share, "of a processor")
    asked, bounded, most, unit = bounds
    fits = [way for way in ways if way.figures[bounded] <= most]
    if not fits:
        least = min(way.figures[bounded] for way in ways)
        raise CommandError(
            Exit.REFUSED,
            "no_way",
            f"{asked} = {most:g}: allowed is at least {least:.3g} {unit}",
            "tormagctl scene explain shows every way; not offered is one that is worse than the usual one",
        )
    least_N = min(way.figures[1] for way in fits)
    alike = [way for way in fits if share is None or way.figures[1] <= (1.0 + ALIKE) * least_N]
    return min(alike, key=lambda way: (len(way.way.given), way.figures[0]))


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
