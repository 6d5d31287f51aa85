"""Which figures a committed picture was drawn from: one that is older than them is found by a test."""

import hashlib

import msgspec

KEY = "Figures"


def stamp(figures: object) -> dict[str, str | None]:
    """The metadata of a PNG drawn from `figures`, which are plain data: their digest, and nothing that changes with
    time or version, so that the same figures make the same file."""
    return {KEY: hashlib.sha256(msgspec.json.encode(figures, order="sorted")).hexdigest(), "Software": None}


def tables(page: str) -> list[str]:
    """The figures of a generated page: the rows of its tables, whatever else it says."""
    return [line for line in page.splitlines() if line.startswith("|")]
