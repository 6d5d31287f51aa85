"""What the laboratory tells instead of a traceback: input that it cannot use, and a package that is not there."""

from importlib.metadata import requires
from pathlib import Path

PACKAGE_OF = {"distributed": "dask[distributed]"}
"By the name that is imported, where pip knows another."


class LabError(ValueError):
    """Input that cannot be used: names the file or the quantity, where in it, what was found and what is allowed."""


def not_installed(module: str) -> str:
    """That `module` is missing, in one sentence with the command that brings it to where tormagd stands."""
    package = PACKAGE_OF.get(module, module)
    library = Path(__file__).resolve().parents[2]
    if library.name == "tormagd" and not (library / "pyproject.toml").exists():  # a folder of its own, as packaged
        needed = next((line for line in requires("tormagd") or () if line.startswith(package)), package)
        command = f"sudo python3 -m pip install --target {library} '{needed.partition(';')[0]}'"
    else:
        command = "pip install 'tormagd[lab]'"
    return f"{package} is not installed: {command}"
