"""Another checkout beside this one: what `--against FOLDER` means to every measurement that has it."""

import argparse
import os
import subprocess
import sys
from pathlib import Path

TOOLS = Path(__file__).parents[1]


def add_against_argument(parser: argparse.ArgumentParser) -> None:
    """`--against FOLDER`."""
    parser.add_argument(
        "--against", type=checkout, metavar="FOLDER", help="root of another checkout, measured in turns with this one"
    )


def checkout(text: str) -> Path:
    """The root of a checkout. Raises ArgumentTypeError for any other folder."""
    root = Path(text).resolve()
    if not (root / "tormagd" / "closed_loop.py").is_file() or not (root / "tools" / "benchmark.py").is_file():
        raise argparse.ArgumentTypeError(f"{text}: allowed is the root of a checkout, with tormagd/ and tools/ in it")
    return root


def environment(root: Path | None) -> dict[str, str]:
    """For a process that runs package and tools of that checkout; None for what runs here, which may be installed."""
    if root is None:
        inherited = os.environ.get("PYTHONPATH")
        folders = [str(TOOLS)] + ([inherited] if inherited else [])
    else:
        folders = [str(root), str(root / "client" / "src"), str(root / "tools")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(folders), "OMP_NUM_THREADS": "1"}


def as_installed(root: Path, folder: Path) -> dict[str, str]:
    """The same, where backends are found, too: by what that checkout's package says of itself, which is written into
    the folder. Raises CalledProcessError."""
    setup = [sys.executable, "-c", "from setuptools import setup; setup()", "--quiet"]
    subprocess.run([*setup, "egg_info", "--egg-base", str(folder)], cwd=root, check=True, capture_output=True)
    found = environment(root)
    return found | {"PYTHONPATH": os.pathsep.join([found["PYTHONPATH"], str(folder)])}
