"""`python -m tormagd.record.replay FILE`: runs a black box again, and prints one JSON object."""

import argparse
import json
import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from firmware_protocol.build import settle
from tormagd.config import load_config
from tormagd.control.assembly.build import sources_hash
from tormagd.ground.terminal import write_line
from tormagd.record.black_box import BlackBoxFile, read_black_box
from tormagd.record.reader import RecordingError
from tormagd.record.replay.rebuild import Recorded, ReplayError, differences, rebuilt, recorded
from tormagd.record.replay.rerun import rerun
from tormagd_client.endpoints import ConfigError


def asked(description: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--config", type=Path)
    return parser


def answered(options: argparse.Namespace, run: Callable[[Recorded, BlackBoxFile], dict[str, Any]]) -> int:
    """Print what a black box is and what `run` gives for it; return the exit code."""
    try:
        configured = None if options.config is None else load_config(options.config)
        box = read_black_box(options.file)
        try:
            known = recorded(box, options.file.absolute().parent)
            result: dict[str, Any] = {
                "file": str(options.file),
                "odd": box.odd,
                "version": known.header["version"],
                "reason": box.header.get("reason", ""),
                "build": str(settle()),
                "is_complete": box.is_complete,
                "differences": differences(known, configured),
                **run(known, box),
            }
        except ReplayError as error:
            other = box.header.get("sources_sha256", "") not in ("", sources_hash())
            hint = "; another tormagd wrote it: replay it with that one" if other else ""
            raise ReplayError(f"{options.file}: {error}{hint}") from error
    except (ConfigError, RecordingError, ReplayError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0 if write_line(json.dumps(result), sys.stdout) is None else 1


def main(arguments: list[str] | None = None) -> int:
    parser = asked(__doc__ or "")
    parser.add_argument("--from", dest="from_s", type=float, default=0.0)
    options = parser.parse_args(arguments)

    def run(known: Recorded, box: BlackBoxFile) -> dict[str, Any]:
        return {"rerun": msgspec.to_builtins(rerun(rebuilt(known), known.columns, box.entries, options.from_s))}

    return answered(options, run)


if __name__ == "__main__":
    logging.disable()  # a replayed connection has no news
    sys.exit(main())
