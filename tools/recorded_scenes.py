"""The public recordings as scenes: what `tormagctl scene new` proposes for each, and which terms it requires.

    recorded_scenes.py [--json]

The recordings are in the folder that TORMAG_DATA names; their scenes are written into build/recorded_scenes.
"""

import argparse
import shutil
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import required_terms
from rendering.scene_runs import ROOT
from rendering.signals import Signal, data_folder, recorded_signals

from tormagd.ctl.scene_new import new_scene

FOLDER = ROOT / "build" / "recorded_scenes"


class Recorded(NamedTuple):
    """A scene, how the name of its signal begins, and what it is."""

    scene: str
    signal: str
    says: str
    is_known_ahead: bool = False


RECORDED = (
    Recorded("tool_torque", "tool torque", "The torque of a da Vinci tool, live."),
    Recorded(
        "arterial_pressure", "arterial pressure", "An arterial pressure as 1.4 to 1.7 N, played.", is_known_ahead=True
    ),
    Recorded("cataract", "haptic scaled", "The forces of a trainer of cataract surgery, played.", is_known_ahead=True),
)


def main() -> int:
    """Writes the scenes and measures them; 0, or 2 where there are no recordings."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    data = data_folder()
    signals = [] if data is None else recorded_signals(data)
    found = [next((each for each in signals if each.name.startswith(recorded.signal)), None) for recorded in RECORDED]
    if any(signal is None for signal in found):
        print("recorded_scenes: TORMAG_DATA: allowed is the folder of the recordings", file=sys.stderr)
        return 2
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    files = [str(written(recorded, signal, FOLDER)) for recorded, signal in zip(RECORDED, found, strict=True) if signal]
    return required_terms.main([*files, "--json"] if options.json else files)


def written(recorded: Recorded, signal: Signal, folder: Path) -> Path:
    """The scene file, as step 1 and 2 of docs/guides/scene.md make it. Raises CommandError where none is taken."""
    forces, scene = folder / f"{recorded.scene}.csv", folder / f"{recorded.scene}.toml"
    rows = np.column_stack([signal.time_s, signal.force_N])
    np.savetxt(forces, rows, fmt="%.6f", delimiter=",", header="t_s,force_N", comments="")
    new_scene(scene, forces, None)
    if recorded.is_known_ahead:
        text = scene.read_text(encoding="utf-8")
        scene.write_text(text.replace("[signal]\n", "[signal]\nis_known_ahead = true\n"), encoding="utf-8")
    return scene


if __name__ == "__main__":
    sys.exit(main())
