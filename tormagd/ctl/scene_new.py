"""`tormagctl scene new`: make a scene file from a recorded force or from answers; the insert is found by trying."""

import contextlib
import math
import os
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from tormagd.config import MIN_INFERENCE_HZ
from tormagd.ctl.outcome import NEW_FILE, CommandError, Exit, Outcome, as_usage_error, is_terminal, usage_error
from tormagd.ctl.scene import as_toml, check_scene
from tormagd.element.physics.errors import DomainError
from tormagd.element.physics.inserts import insert as known_insert
from tormagd.ground.files import new_file
from tormagd.ground.force_file import read_column, read_forces, stated_columns
from tormagd.ground.table import TableError
from tormagd.scenes.scene import AND_UNMET, AUTO, MIN_CONTROL_HZ, Scene
from tormagd.scenes.signal import recorded
from tormagd_client.endpoints import ConfigError

INSERTS = ("MRE-10-10", "MRE-10-20", "MRE-50-40")
"From the softest, whose least force is the lowest."
TOLERATED, TOLERATED_OF_MOST = 0.05, 0.02
"The proposed tolerance is this share of the range, but at least this share of the greatest force."
UNMET = "# NOT MET: "
"Begins a line of a scene file that says what the device does not give."

Tables = dict[str, Any]


class Recorded(NamedTuple):
    """A recorded quantity that becomes the scene's force, and what a person states of the scene."""

    force: Path | None
    "A file with times and one column of the quantity; without it, a person is asked."
    column: str | None
    time_column: str | None
    scale: float | None
    "Newtons for each unit of the column."
    offset_N: float | None
    insert: str | None
    "By default the softest that renders the scene."
    tolerance_N: float | None


def new_scene(out: Path, config_file: Path | None, **stated: Any) -> Outcome:
    """Make the scene file `out` of a `Recorded` quantity, or of answers."""
    recorded = Recorded(**stated)
    if out.exists() or not out.parent.is_dir():
        raise usage_error(f"{out}: {NEW_FILE}", "name another file")
    with as_usage_error(DomainError, hint="tormagctl scene new --help"):
        known_insert(INSERTS[0] if recorded.insert is None else recorded.insert)
    with as_usage_error(OSError, hint=f"name another file: {NEW_FILE}"), contextlib.ExitStack() as files:
        force_file, told = _forces_of(out, recorded, files)
        made = _proposed(out, force_file, recorded, config_file)
    if not told:
        return made
    text = f"{recorded.force}: {'; '.join(told)}\n{made.text}"
    return msgspec.structs.replace(made, result=made.result | {"read": told}, text=text)


def _proposed(out: Path, force_file: Path | None, recorded: Recorded, config: Path | None) -> Outcome:
    """Write the scene file `out` for the forces in `force_file`, or from a person's answers."""
    tables = _from_answers(out.stem) if force_file is None else _from_recording(out, force_file)
    if recorded.tolerance_N is not None:
        tables["force"] |= {"tolerance_rms_N": recorded.tolerance_N, "resolution_N": 2.0 * recorded.tolerance_N}
    inserts = INSERTS if recorded.insert is None else (recorded.insert,)
    try:
        msgspec.convert(_with(tables, inserts[0]), Scene)
    except msgspec.ValidationError as error:
        raise usage_error(
            f"no scene can be made of this: {error}", "tormagctl guide scenes says what each key asks"
        ) from error
    with new_file(out):
        return _chosen(out, tables, inserts, config)


def _chosen(out: Path, tables: Tables, inserts: Sequence[str], config: Path | None) -> Outcome:
    """Write the scene with the softest of `inserts` that renders it, else marked with what is not met."""
    lacks: dict[str, list[str]] = {}
    for insert in inserts:
        _write(out, tables, insert)
        try:
            checked = check_scene(str(out), config)
        except CommandError as error:
            reason = error.message.removeprefix(f"scene {tables['name']}: ")
            # a machine too busy to say, or an unknown insert or model
            if error.code not in ("refused", "budget") or reason.startswith("insert."):
                raise
            lacks[insert] = reason.split(AND_UNMET)
        else:
            said = f"{out} is written, with insert {insert}: its tolerance, handle and rates are proposals"
            found = {"file": str(out), "insert": insert, "unmet": []}
            return Outcome(checked.result | found, f"{checked.text}\n\n{said}")
    # the softest of those that are strong enough follows fastest; else the stiffest
    strong = [name for name in inserts if not any(reason.startswith("force.most_N") for reason in lacks[name])]
    insert = min(strong, key=lambda name: len(lacks[name])) if strong else inserts[-1]
    _write(out, tables, insert, lacks[insert])
    said = f"{out} is written, with insert {insert}, and is NOT MET:\n" + "\n".join(lacks[insert])
    hint = "state what is allowed, or another --insert, --tolerance, --scale or --offset"
    return Outcome({"file": str(out), "insert": insert, "unmet": lacks[insert]}, f"{said}\n{hint}", Exit.REFUSED)


def _forces_of(out: Path, recorded: Recorded, files: contextlib.ExitStack) -> tuple[Path | None, list[str]]:
    """Return the file of the scene's forces, if need be a converted one, in `files`, and what was converted."""
    stated = stated_columns(recorded.column, recorded.time_column)
    is_converted = bool(stated) or (recorded.scale, recorded.offset_N) != (None, None)
    if recorded.force is None:
        if is_converted:
            raise usage_error(
                "--column, --time-column, --scale and --offset convert a recorded force", "add --force FORCE.csv"
            )
        return None, []
    with as_usage_error(TableError, hint="--column, --time-column, --scale and --offset say what the file has"):
        if not is_converted:
            return recorded.force, read_forces(recorded.force, stated).told
        table = read_column(recorded.force, stated, has_unit=recorded.scale is None)
    converted = out.with_suffix(".csv")
    scale, offset_N = (1.0 if recorded.scale is None else recorded.scale), recorded.offset_N or 0.0
    rows = zip(table.values["time_s"], table.values["force_N"], strict=True)
    try:
        files.enter_context(new_file(converted))
    except FileExistsError as error:
        raise usage_error(f"{converted} exists, where the scene's forces go", "give another FILE.toml") from error
    lines = (f"{time_s!r},{offset_N + scale * value:.6g}\n" for time_s, value in rows)
    converted.write_text(f"t_s,force_N\n{''.join(lines)}", encoding="utf-8")
    return converted, table.told


def _with(tables: Tables, insert: str) -> Tables:
    return tables | {"insert": {"name": insert, "model": AUTO}}


def _write(out: Path, tables: Tables, insert: str, unmet: Sequence[str] = ()) -> None:
    lines = [line for reason in unmet for line in textwrap.wrap(f"{UNMET}{reason}", 100, subsequent_indent="#   ")]
    out.write_text("\n".join([*lines, as_toml(_with(tables, insert))]) + "\n", encoding="utf-8")


def _from_recording(out: Path, force_file: Path) -> Tables:
    """Propose a scene's tables for a recorded force, at a steady handle of 42 mm/s."""
    hint = "no force below 0; else --scale or --offset"
    with as_usage_error(ConfigError, hint=hint):
        time_s, force_N = recorded(force_file)
    least_N, most_N = _rounded(float(force_N.min()), math.floor), _rounded(float(force_N.max()), math.ceil)
    if not least_N < most_N:
        raise usage_error(
            f"{force_file}: a force of {most_N:g} N throughout has no range: allowed is one that changes",
            "a scene that holds one force is made by answering: tormagctl scene new FILE.toml",
        )
    tolerance_N = _rounded(max(TOLERATED * (most_N - least_N), TOLERATED_OF_MOST * most_N), math.ceil)
    said = f"What {force_file.name} asks for in {time_s[-1]:.0f} s: {least_N:g} to {most_N:g} N."
    signal = {"file": os.path.relpath(force_file, out.parent)}
    return _tables(out.stem, said, least_N, most_N, 2.0 * tolerance_N, tolerance_N, signal, (42.0, 42.0))


def _from_answers(name: str) -> Tables:
    """Ask a person for each value of the scene, each with a proposal, and return its tables."""
    if not is_terminal(sys.stdin):
        raise usage_error(
            "stdin is no terminal: there is nobody to ask",
            "give a recorded force: --force FORCE.csv, columns t_s,force_N",
        )
    print("A scene states one task; Enter takes what stands in brackets.", file=sys.stderr)
    said = _answer("what is done, in a sentence", f"{name}.")
    least_N = _number("least force, N", 0.0)
    most_N = _number("greatest force, N", 2.0)
    tolerance_N = _number("RMS error of the force that is tolerated, N", TOLERATED * (most_N - least_N))
    resolution_N = _number("smallest difference of force that matters, N", 2.0 * tolerance_N)
    signal = {
        "bandwidth_hz": _number("how fast a force rises: it takes half a period of, Hz", 0.2),
        "hold_s": _number("and is held then, s", 0.0),
    }
    slowest_mm_s = _number("slowest handle, mm/s at the roller", 42.0)
    fastest_mm_s = _number("fastest handle, mm/s", slowest_mm_s)
    return _tables(name, said, least_N, most_N, resolution_N, tolerance_N, signal, (slowest_mm_s, fastest_mm_s))


def _answer(question: str, usual: str) -> str:
    print(f"{question} [{usual}]: ", end="", file=sys.stderr, flush=True)
    line = sys.stdin.readline()
    if not line:
        raise usage_error("stdin ended before the last answer", "answer all questions, or give --force FORCE.csv")
    return line.strip() or usual


def _number(question: str, usual: float) -> float:
    """Ask until the answer is a number."""
    while True:
        answer = _answer(question, f"{usual:g}")
        try:
            return float(answer)
        except ValueError:
            print("  allowed is a number", file=sys.stderr)


def _tables(
    name: str,
    description: str,
    least_N: float,
    most_N: float,
    resolution_N: float,
    tolerance_N: float,
    signal: Tables,
    handle_mm_s: tuple[float, float],
) -> Tables:
    force = {"least_N": least_N, "most_N": most_N, "resolution_N": resolution_N, "tolerance_rms_N": tolerance_N}
    return {
        "name": name,
        "description": description,
        "force": {key: float(f"{value:.3g}") for key, value in force.items()},
        "signal": signal,
        "handle": dict(zip(("least_mm_s", "most_mm_s"), handle_mm_s, strict=True)),
        "bandwidth": {"control_hz": MIN_CONTROL_HZ, "inference_hz": MIN_INFERENCE_HZ},
    }


def _rounded(value: float, direction: Callable[[float], int]) -> float:
    unit = 10.0 ** (math.floor(math.log10(max(value, 1e-6))) - 1)
    return float(f"{direction(round(value / unit, 6)) * unit:.3g}")
