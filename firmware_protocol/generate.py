"""Generates the Python modules, the README's message tables, the C codec and the golden vectors from `tormag.dbc`.

`python -m firmware_protocol.generate` writes them. With `--check` it only compares: it prints the difference from the
committed files, and the exit code is 1 if there is one.
"""

import argparse
import difflib
import sys
from pathlib import Path
from typing import Final

from firmware_protocol.c.source import c_files
from firmware_protocol.dbc import DBC, Schema, SignalSource, read_schema
from firmware_protocol.golden import vector_files
from firmware_protocol.python_source import python_files

TABLE_BEGIN: Final = "<!-- generated from tormag.dbc: begin -->"
TABLE_END: Final = "<!-- generated from tormag.dbc: end -->"


def markdown_tables(schema: Schema) -> str:
    lines = [TABLE_BEGIN, f"Protocol version {schema.version}, schema hash `{schema.schema_hash():08X}`.", ""]
    for message in schema.messages:
        lines += [
            f"### {message.name}",
            "",
            f"{message.sender} to {message.receiver}, function {message.function}, CAN "
            f"0x{message.frame_id:03X}, length {message.length}. {message.comment}",
            "",
            "| bytes | signal | type | values | meaning |",
            "| --- | --- | --- | --- | --- |",
            *(_markdown_row(signal) for signal in message.signals),
            "",
        ]
    return "\n".join([*lines, TABLE_END])


def _markdown_row(signal: SignalSource) -> str:
    first, last = signal.start // 8, (signal.start + signal.length) // 8 - 1
    place = f"{first}" if first == last else f"{first}-{last}"
    wire_type = f"{'i' if signal.signed else 'u'}{signal.length}"
    if signal.choices:
        values = ", ".join(f"{value} {name}" for value, name in signal.choices.items())
    elif signal.scale == 1 and not signal.unit and signal.maximum - signal.minimum == 2**signal.length - 1:
        values = ""  # all that the type holds
    else:
        step = f"{signal.scale:.10g} {signal.unit}".rstrip()
        wraps = ", wraps" if signal.kind == "Wrapping" else ""
        values = f"{signal.minimum:.10g} .. {signal.maximum:.10g}, step {step}{wraps}"
    return f"| {place} | `{signal.name}` | {wire_type} | {values} | {signal.comment} |"


def generated_files(room: Path) -> dict[Path, str]:
    """Return the text that each generated file of a folder should have, by its path."""
    schema = read_schema(room / DBC.name)
    before, rest = (room / "README.md").read_text(encoding="utf-8").split(TABLE_BEGIN)
    after = rest.split(TABLE_END)[1]
    files = {room / name: text for name, text in python_files(schema).items()}
    files |= {room / "README.md": before + markdown_tables(schema) + after}
    files |= {room / "c" / name: text for name, text in c_files(schema, room / DBC.name).items()}
    return files | {room / "vectors" / name: text for name, text in vector_files(schema, room / DBC.name).items()}


def main(arguments: list[str] | None = None, room: Path = DBC.parent) -> int:
    parser = argparse.ArgumentParser(prog="python -m firmware_protocol.generate", description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if a file is out of date")
    check: bool = parser.parse_args(arguments).check
    stale = []
    for path, wanted in generated_files(room).items():
        present = path.read_text(encoding="utf-8") if path.exists() else ""
        if present == wanted:
            continue
        stale.append(path.name)
        if check:
            labels = f"{path.name} as committed", f"{path.name} from the DBC"
            sys.stdout.writelines(difflib.unified_diff(present.splitlines(True), wanted.splitlines(True), *labels, n=1))
        else:
            path.write_text(wanted, encoding="utf-8")
            print(f"wrote {path.name}")
    if check and stale:
        print(f"out of date: {', '.join(stale)}; remedy: python -m firmware_protocol.generate")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
