"""Prints what LIBRARY has inside, as CycloneDX: python -P systemd/sbom.py LIBRARY PAGE.

PAGE is the dashboard's folder, whose script names its version. A compiled wheel brings the list of its crates itself.
"""

import json
import re
import sys
from importlib.metadata import distributions
from pathlib import Path


def components(library: str, page: Path) -> list[dict[str, str]]:
    inside = [("pypi", found.name, found.version) for found in distributions(path=[library]) if found.name]
    drawing = re.search(r"\(v([\d.]+)\)", (page / "vendor/uPlot.iife.min.js").read_text(encoding="utf-8"))
    assert drawing is not None
    return [
        {"type": "library", "name": name, "version": version, "purl": f"pkg:{kind}/{name.lower()}@{version}"}
        for kind, name, version in sorted([*inside, ("npm", "uPlot", drawing[1])])
    ]


if __name__ == "__main__":
    found = components(sys.argv[1], Path(sys.argv[2]))
    print(json.dumps({"bomFormat": "CycloneDX", "specVersion": "1.6", "version": 1, "components": found}, indent=1))
