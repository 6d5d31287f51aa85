"""What the laboratory says instead of a traceback, for unusable input and for missing packages."""

from importlib.metadata import requires
from pathlib import Path

PACKAGE_OF = {"distributed": "dask[distributed]"}
"The name that pip takes, where it differs from the imported one."


class LabError(ValueError):
    """Unusable input. The message names the file or quantity, the place, the value and what is allowed."""


def not_installed(module: str) -> str:
    """Return the sentence `PACKAGE is not installed: COMMAND` for a module."""
    package = PACKAGE_OF.get(module, module)
    library = Path(__file__).resolve().parents[1]
    if library.name == "tormagd":  # packaged in a folder of its own
        lines = [*(requires("tormagd") or ()), *(requires("tormag-lab") or ())]
        needed = next((line for line in lines if line.startswith(package)), package)
        command = f"sudo python3 -m pip install --target {library} '{needed.partition(';')[0]}'"
    else:
        command = "pip install 'tormag-lab[all]'"
    return f"{package} is not installed: {command}"
