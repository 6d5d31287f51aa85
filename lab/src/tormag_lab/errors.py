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
    library = Path(__file__).resolve().parents[2]
    if library.name == "tormagd" and not (library / "pyproject.toml").exists():  # packaged in a folder of its own
        needed = next((line for line in requires("tormagd") or () if line.startswith(package)), package)
        command = f"sudo python3 -m pip install --target {library} '{needed.partition(';')[0]}'"
    else:
        command = "pip install 'tormagd[lab]'"
    return f"{package} is not installed: {command}"
