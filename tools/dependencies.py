"""Prints this project's requirements for `pip install -r`, so that they are fetched while the core is compiled."""

import re
import sys
import tomllib
from pathlib import Path

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"


def requirements(extras: list[str]) -> list[str]:
    """Return what `pip install ./client '.[extras]'` would fetch, without this project and its client."""
    project = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]
    ours = re.compile(rf"{project['name']}\[(.*)\]")
    found = [requirement for requirement in project["dependencies"] if not requirement.startswith("tormagd-client==")]
    waiting = list(extras)
    while waiting:
        for requirement in project["optional-dependencies"][waiting.pop(0)]:
            own = ours.fullmatch(requirement)
            if own is None:
                found.append(requirement)
            else:
                waiting += own[1].split(",")
    return sorted(set(found))


if __name__ == "__main__":
    print(*requirements(sys.argv[1:]), sep="\n")
