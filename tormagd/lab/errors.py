"""What the laboratory says instead of a traceback: input that it cannot use, and a package that is missing."""

from importlib.metadata import requires
from pathlib import Path

PACKAGE_OF = {"distributed": "dask[distributed]"}
"pip's name of a package, by the name that is imported, where they differ."


class LabError(ValueError):
    """Input that cannot be used: the message names the file or quantity, the place in it, the value and what is
    allowed."""


def not_installed(module: str) -> str:
    """Return the sentence `PACKAGE is not installed: COMMAND`, for the module `module`; whether it is missing is not
    checked."""
    package = PACKAGE_OF.get(module, module)
    library = Path(__file__).resolve().parents[2]
    if library.name == "tormagd" and not (library / "pyproject.toml").exists():  # a folder of its own, as packaged
        needed = next((line for line in requires("tormagd") or () if line.startswith(package)), package)
        command = f"sudo python3 -m pip install --target {library} '{needed.partition(';')[0]}'"
    else:
        command = "pip install 'tormagd[lab]'"
    return f"{package} is not installed: {command}"
