"""`python -m tormagd.record.replay FILE`: runs a black box again, and prints one JSON object; `tormagctl replay` shows it."""

import argparse
import json
import logging
import sys
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
from tormagd.simulation.rehearse import changed, rehearse, script
from tormagd_client.endpoints import ConfigError


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tormagd.record.replay", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("file", type=Path)
    parser.add_argument("--from", dest="from_s", type=float, default=0.0)
    parser.add_argument("--set", dest="settings", action="append", default=[])
    parser.add_argument("--plant", default="sample_1")
    parser.add_argument("--fault", dest="faults", action="append", default=[])
    parser.add_argument("--config", type=Path)
    options = parser.parse_args(arguments)
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
            }
            if options.settings or options.faults:
                result |= _rehearsed(known, box, options)
            else:
                done = rerun(rebuilt(known), known.columns, box.entries, options.from_s)
                result["rerun"] = msgspec.to_builtins(done)
        except ReplayError as error:
            other = box.header.get("sources_sha256", "") not in ("", sources_hash())
            hint = "; another tormagd wrote it: replay it with that one" if other else ""
            raise ReplayError(f"{options.file}: {error}{hint}") from error
    except (ConfigError, RecordingError, ReplayError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0 if write_line(json.dumps(result), sys.stdout) is None else 1


def _rehearsed(known: Recorded, box: BlackBoxFile, options: argparse.Namespace) -> dict[str, Any]:
    """Rehearse the black box with the recorded configuration, and again where settings change it."""
    todo = script(known.columns, box.entries)
    config = changed(known.config, options.settings)
    simulated = rehearse(rebuilt(known), known.config, todo, options.plant, options.faults)
    instead = None
    if options.settings:
        instead = rehearse(rebuilt(known, config), config, todo, options.plant, options.faults)
    return {
        "plant": options.plant,
        "faults": options.faults,
        "settings": options.settings,
        "recorded": msgspec.to_builtins(todo.recorded),
        "simulated": msgspec.to_builtins(simulated),
        "instead": msgspec.to_builtins(instead),
    }


if __name__ == "__main__":
    logging.disable()  # a replayed connection has no news
    sys.exit(main())
