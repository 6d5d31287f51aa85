"""Prints what tormagd and its laboratory require for `pip install -r`; it is fetched while the core is compiled."""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
OURS = re.compile(r"tormag(?:d|d-client|-lab)(?:\[(.*)\])?(?:==.*)?")


def requirements(extras: list[str]) -> list[str]:
    """Return what `pip install ./client '.[extras]' './lab[extras]'` would fetch besides these three."""
    texts = (path.read_text(encoding="utf-8") for path in (ROOT / "pyproject.toml", ROOT / "lab/pyproject.toml"))
    projects = [tomllib.loads(text)["project"] for text in texts]
    known = {name: needed for each in projects for name, needed in each["optional-dependencies"].items()}
    waiting = [requirement for each in projects for requirement in each["dependencies"]]
    waiting += [requirement for name in extras for requirement in known[name]]
    found = set()
    while waiting:
        requirement = waiting.pop()
        own = OURS.fullmatch(requirement)
        if own is None:
            found.add(requirement)
        elif own[1]:
            waiting += [each for name in own[1].split(",") for each in known[name]]
    return sorted(found)


if __name__ == "__main__":
    print(*requirements(sys.argv[1:]), sep="\n")
