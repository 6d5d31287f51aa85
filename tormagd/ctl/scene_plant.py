"""`tormagctl scene check NAME --plant FILE`: what a simulated device, as a twin of the real one, gives of a scene."""

import tempfile
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from tormagd.ctl.outcome import CommandError, Exit, answer_of, usage_error
from tormagd.scenes.scene import Scene, scene_path
from tormagd.scenes.signal import asked

LONGEST_S, SIGNAL_S, SIGNAL_HZ = 120.0, 5.0, 200
"This much of the scene's signal is enough."


def on_plant(scene: Scene, name: str, plant: str) -> dict[str, Any]:
    """Return what ideal carriages of `plant` give of a scene: range and RMS errors, N."""
    force = scene.force
    times_s, forces_N = (
        np.array([0.0, SIGNAL_S / 2.0, SIGNAL_S]),
        np.array([force.least_N, force.most_N, force.least_N]),
    )
    if scene.signal is not None:
        beside = Path(str(scene_path(name))).parent
        times_s, forces_N = asked(scene.signal, beside, (force.least_N, force.most_N), SIGNAL_S, SIGNAL_HZ)
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "asked.csv"
        np.savetxt(table, np.column_stack([times_s, forces_N]), "%.6f", ",", header="t_s,force_N", comments="")
        words = ["bound", str(table), "--json", f"--plant={plant}", f"--insert={scene.insert.name}"]
        try:
            found: dict[str, Any] = msgspec.json.decode(answer_of("tormagd.lab.__main__", words, LONGEST_S))
        except (TimeoutError, ChildProcessError) as error:
            # the laboratory names the command that installs what it lacks
            said, lacks, remedy = str(error).partition(" is not installed")
            hint = remedy.removeprefix(": ") or "tormag-lab twin makes a plant file"
            raise usage_error(f"--plant {plant}: {said}{lacks}", hint) from error
    for key, value, most in (
        ("force.most_N", force.most_N, found["most_N"]),
        ("the RMS error of ideal carriages", found["foresight_rms_N"], force.tolerance_rms_N),
    ):
        if value > most:
            reason = f"scene {scene.name}: {key} = {value:.3g} on plant {plant}: allowed is {most:.3g}"
            raise CommandError(Exit.REFUSED, "refused", reason, "tormag-lab twin fits a plant to your device")
    return {"plant": plant, **found}
