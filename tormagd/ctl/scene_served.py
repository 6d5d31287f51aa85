"""`tormagctl scene check NAME --share | --tolerance`: how a scene is served at a price, or within an error."""

import os
from pathlib import Path
from typing import Any

import msgspec

from tormagd.ctl.outcome import CommandError, Exit, Outcome, as_usage_error, usage_error
from tormagd.ctl.scene import as_toml, measured_as
from tormagd.scenes.measured import OperatingPoint, Share, Tried, measured
from tormagd.scenes.scene import load_scene, scene_path
from tormagd_client.endpoints import ConfigError


def serve_scene(action: str, name: str, share: float | None, tolerance_N: float | None, out: Path | None) -> Outcome:
    """Choose the most exact measured way that takes at most `share` of a processor, or the cheapest within an error.

    The error is `tolerance_N`, RMS; one of both is None. With `out` writes the scene, served that way, to this new
    file. Raises CommandError: USAGE for another action than check, for both or neither limit, and for files that cannot
    be used. REFUSED where nothing was measured, or no way is good enough.
    """
    if action != "check" or (share is None) == (tolerance_N is None):
        raise usage_error(
            "--share, --tolerance and --out choose how a scene is served",
            "tormagctl scene check NAME with one of --share S and --tolerance N, and --out FILE.toml to write it",
        )
    with as_usage_error(ConfigError, hint="tormagctl scene list shows the shipped ones"):
        scene = load_scene(name)
    file = measured()
    ways = [
        (tried, share_of) for tried in measured_as(scene, file).tried if (share_of := file.share(tried.way)) is not None
    ]
    tried, taken = _max_wanted(ways, share, tolerance_N or 0.0)
    text = (
        f"{scene.name}: {tried.way}: {1e3 * tried.worst_N:.1f} mN RMS at worst on samples 1 to 3, "
        f"the daemon takes {taken.daemon:.1%} of a processor"
    )
    if out is not None:
        _write(name, tried.way, out)
        text += f"\n{out} is written: tormagd --scene {out}"
    result = {"scene": scene.name, "way": msgspec.to_builtins(tried.way), "rms_N": tried.worst_N}
    return Outcome(result | {"daemon_share": taken.daemon, "file": None if out is None else str(out)}, text)


Served = tuple[Tried, Share]


def _max_wanted(ways: list[Served], share: float | None, tolerance_N: float) -> Served:
    """Return the most exact of `ways` that takes at most `share`, or for None the cheapest within `tolerance_N`.

    Raises CommandError (REFUSED) where no way does, ValueError where there is none at all.
    """

    def price(way: Served) -> float:
        return way[1].daemon

    def error_N(way: Served) -> float:
        return way[0].worst_N

    asked, most, limited, best, unit = "--tolerance", tolerance_N, error_N, price, "N"
    if share is not None:
        asked, most, limited, best, unit = "--share", share, price, error_N, "of a processor"
    fits = [way for way in ways if limited(way) <= most]
    if not fits:
        raise CommandError(
            Exit.REFUSED,
            "no_way",
            f"{asked} = {most:g}: allowed is at least {min(map(limited, ways)):.3g} {unit}",
            "tormagctl scene explain shows every way that was measured",
        )
    return min(fits, key=best)


def _write(name: str, way: OperatingPoint, out: Path) -> None:
    """Write the scene with these rates and this search to the new file `out`; relative paths in it are adapted.

    `[bandwidth]` and `[solver]` are replaced whole: a search's own settings are dropped.

    Raises CommandError (USAGE) where `out` exists or cannot be made.
    """
    path = scene_path(name)
    tables: dict[str, Any] = msgspec.to_builtins(load_scene(name))
    tables = {key: value for key, value in tables.items() if value is not None}
    if (signal := tables.get("signal")) and signal["file"]:
        signal["file"] = os.path.relpath(path.parent / signal["file"], out.parent)
    if (path.parent / tables["insert"]["model"]).is_file():
        tables["insert"]["model"] = os.path.relpath(path.parent / tables["insert"]["model"], out.parent)
    tables["bandwidth"] = {"control_hz": way.control_hz, "inference_hz": way.inference_hz}
    tables["solver"] = {"name": way.search}
    try:
        with out.open("x", encoding="utf-8") as file:
            file.write(as_toml(tables) + "\n")
    except OSError as error:
        raise usage_error(
            f"{out}: {error.strerror}: allowed is a new file in a folder that exists", "name another"
        ) from error
