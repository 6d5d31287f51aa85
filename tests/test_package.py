"""What is installed: every file beside the sources that they, or type checkers, look for."""

import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = "tormagd", "firmware_protocol"
DATA = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["package-data"]
NOT_INSTALLED = {".py", ".so", ".md", ".pyc"}
MADE = {"firmware_protocol/core.json"}


def test_every_file_beside_the_sources_is_installed() -> None:
    listed = {
        path
        for package, patterns in DATA.items()
        for pattern in patterns
        for path in (ROOT / package.replace(".", "/")).glob(pattern)
    }
    there = {path for package in PACKAGES for path in (ROOT / package).rglob("*") if path.is_file()}
    needed = {path for path in there if path.suffix not in NOT_INSTALLED}
    assert not ({str(path.relative_to(ROOT)) for path in needed - listed} - MADE)


@pytest.mark.parametrize("package", PACKAGES)
def test_the_package_says_that_it_is_typed(package: str) -> None:
    assert (ROOT / package / "py.typed").exists()
    assert "py.typed" in DATA[package]
