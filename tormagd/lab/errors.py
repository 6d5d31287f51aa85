"""What the laboratory says instead of a traceback: input that it cannot use, and a package that is missing."""

from importlib.metadata import requires
from pathlib import Path

PACKAGE_OF = {"distributed": "dask[distributed]"}
"pip's name of a package, by the name that is imported, where they differ."


class LabError(ValueError):
    """Input that cannot be used: the message names the file or quantity, the place in it, the value and what is
    allowed."""


def not_installed(module: str) -> str:
    """Return one sentence that pip's package of the module `module` is missing, with the command that installs it.

    PACKAGE_OF names packages that are not called like their module. The command takes the extra `lab`. For a packaged
    tormagd it takes that package alone, in the versions that tormagd needs, into the folder where tormagd is installed.
    """
    package = PACKAGE_OF.get(module, module)
    library = Path(__file__).resolve().parents[2]
    if library.name == "tormagd" and not (library / "pyproject.toml").exists():  # a folder of its own, as packaged
        needed = next((line for line in requires("tormagd") or () if line.startswith(package)), package)
        command = f"sudo python3 -m pip install --target {library} '{needed.partition(';')[0]}'"
    else:
        command = "pip install 'tormagd[lab]'"
    return f"{package} is not installed: {command}"
