"""The compiled core and the interpreted one are one core: the same histories give the same results, to the bit."""

import json
import os
import shutil
import subprocess
import sys
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

import pytest

from firmware_protocol.build import SWITCH, judged

ROOT = Path(__file__).parents[2]
HISTORIES = Path(__file__).parent / "histories.py"


def started(switch: str) -> subprocess.Popen[str]:
    environment = {**os.environ, SWITCH: switch, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen([sys.executable, "-P", str(HISTORIES)], env=environment, stdout=subprocess.PIPE, text=True)


def told(process: subprocess.Popen[str]) -> dict[str, Any]:
    out, _ = process.communicate()
    assert process.returncode == 0
    answer: dict[str, Any] = json.loads(out)
    return answer


def test_both_builds_give_the_same_results_to_the_bit() -> None:
    build, _ = judged(ROOT, None)
    if not build.is_compiled:
        pytest.skip(f"there is one build only, {build}")
    compiled, interpreted = map(told, [started("1"), started("0")])
    assert (compiled["is_compiled"], interpreted["is_compiled"]) == (True, False)
    assert compiled["digest"] == interpreted["digest"]


def test_what_an_earlier_build_left_does_not_run_where_none_was_made(tmp_path: Path) -> None:
    pytest.importorskip("setuptools")
    for folder in ("firmware_protocol", "tormagd", "client"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    for name in ("setup.py", "pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, tmp_path)
    left = tmp_path / "firmware_protocol" / f"checksum{EXTENSION_SUFFIXES[0]}"
    left.write_bytes(b"of another day")
    subprocess.run(
        [sys.executable, "setup.py", "-q", "build_ext", "--inplace"],
        cwd=tmp_path,
        env={**os.environ, "TORMAG_COMPILE": "skip"},
        check=True,
    )
    shown = "from firmware_protocol import build, checksum; print(build.settle(), checksum.__file__)"
    environment = {**os.environ, SWITCH: "1", "PYTHONPATH": str(tmp_path)}
    ran = subprocess.run(
        [sys.executable, "-P", "-c", shown], env=environment, capture_output=True, text=True, check=True
    )
    assert (
        ran.stdout
        == f"interpreted: when it was installed, TORMAG_COMPILE=skip {tmp_path}/firmware_protocol/checksum.py\n"
    )
