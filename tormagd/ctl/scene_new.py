"""`tormagctl scene new`: make a scene file from a recorded force or from answers; the insert is found by trying."""

import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from tormagd.config import MIN_INFERENCE_HZ
from tormagd.ctl.outcome import CommandError, Exit, Outcome, as_usage_error, is_terminal, usage_error
from tormagd.ctl.scene import as_toml, check_scene
from tormagd.scenes.scene import MIN_CONTROL_HZ, Scene
from tormagd.scenes.signal import recorded
from tormagd_client.endpoints import ConfigError

INSERTS = ("MRE-10-10", "MRE-10-20", "MRE-50-40")
"Inserts with a shipped model, from the softest, whose least force is the lowest."
TOLERATED, TOLERATED_OF_MOST = 0.05, 0.02
"Proposed tolerance: this share of the range, and at least this share of the greatest force."
RESERVED = 0.8
"""Share of the greatest force that the model gives. A device may be a fifth weaker than its model, by friction,
modulus, field and relaxation. A soft insert is asked for more only where no stiffer one follows fast enough."""

Tables = dict[str, Any]


def new_scene(out: Path, force_file: Path | None, config: Path | None) -> Outcome:
    """Write the new scene file `out` from a recorded force, or for None from a person's answers, with a fitting insert.

    `config` is the configuration to check it by; None means the defaults. The text warns of a greatest force over
    RESERVED of the device's. Raises CommandError (USAGE) for files and answers that cannot be used, or nobody to ask.
    Raises it (REFUSED) where no shipped insert renders the scene, or the check fails. Then there is no file.
    """
    if out.exists() or not out.parent.is_dir():
        raise usage_error(f"{out}: allowed is a new file in a folder that exists", "name another file")
    tables = _from_answers(out.stem) if force_file is None else _from_recording(out, force_file)
    try:
        msgspec.convert(_with(tables, INSERTS[0]), Scene)
    except msgspec.ValidationError as error:
        raise usage_error(f"no scene can be made of this: {error}", "docs/scenes.md says what each key asks") from error
    insert, checked = _softest(out, tables, config)
    text = f"{checked.text}\n\n{out} is written, with insert {insert}: its tolerance, handle and rates are proposals"
    if not _has_reserve(tables, checked):
        text += f"\nits greatest force is over {RESERVED:.0%} of the device's: a weak device does not give it"
    return Outcome(checked.result | {"file": str(out), "insert": insert}, text)


def _softest(out: Path, tables: Tables, config: Path | None) -> tuple[str, Outcome]:
    """Write the file with the softest insert that gives the scene with RESERVED to spare, else the softest at all.

    Raises CommandError, and deletes the file, where no insert gives it or the check fails.
    """
    taken: dict[str, Outcome] = {}
    refused = {}
    for insert in INSERTS:
        _write(out, tables, insert)
        try:
            taken[insert] = check_scene(str(out), config)
        except CommandError as error:
            if error.code != "refused":  # such as a machine too busy to say
                out.unlink()
                raise
            refused[insert] = error.message
            continue
        if _has_reserve(tables, taken[insert]):
            return insert, taken[insert]
    if taken:
        insert = next(iter(taken))
        _write(out, tables, insert)
        return insert, taken[insert]
    out.unlink()
    raise CommandError(
        Exit.REFUSED,
        "refused",
        "no shipped insert renders this: " + "; ".join(f"{insert}: {reason}" for insert, reason in refused.items()),
        "record or ask for slower or lower forces, or train a model of another insert (tormagctl calibrate --insert)",
    )


def _with(tables: Tables, insert: str) -> Tables:
    return tables | {"insert": {"name": insert, "model": "torque_" + insert.lower().replace("-", "_")}}


def _write(out: Path, tables: Tables, insert: str) -> None:
    out.write_text(as_toml(_with(tables, insert)) + "\n", encoding="utf-8")


def _has_reserve(tables: Tables, checked: Outcome) -> bool:
    """Return whether the scene's greatest force is at most RESERVED of the device's."""
    return bool(tables["force"]["most_N"] <= RESERVED * checked.result["most_N"])


def _from_recording(out: Path, force_file: Path) -> Tables:
    """Propose a scene's tables for a recorded force: its range, rounded outwards, a tolerance, a steady handle of 42
    mm/s.

    The resolution is twice the tolerance; the file is named relative to `out`. Raises CommandError (USAGE) for a bad
    file, or a force that does not change.
    """
    with as_usage_error(ConfigError, hint="a CSV with the columns t_s,force_N"):
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
    """Ask a person for each value of a scene, each with a proposal, and return its tables.

    Raises CommandError (USAGE) where stdin is no terminal, or ends.
    """
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
    """Ask one question on stderr; an empty line takes `usual`. Raises CommandError (USAGE) where stdin ends."""
    print(f"{question} [{usual}]: ", end="", file=sys.stderr, flush=True)
    line = sys.stdin.readline()
    if not line:
        raise usage_error("stdin ended before the last answer", "answer all questions, or give --force FORCE.csv")
    return line.strip() or usual


def _number(question: str, usual: float) -> float:
    """Ask until the answer is a number, `nan` and `inf` included; an empty line takes `usual`. Raises as `_answer`."""
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
    """Return a scene's tables without an insert, at the least rates; forces are rounded to three digits."""
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
    """Round to two significant digits, down by `math.floor` or up by `math.ceil`."""
    unit = 10.0 ** (math.floor(math.log10(value or 1.0)) - 1)
    return float(f"{direction(round(value / unit, 6)) * unit:.3g}")
