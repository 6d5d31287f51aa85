"""Generated Markdown pages, and pictures that carry the digest of their figures."""

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

if TYPE_CHECKING:
    from tormagd.view.drawing import Figure

KEY = "Figures"


def stamp(figures: object) -> dict[str, str | None]:
    """Return PNG metadata with the SHA-256 digest of `figures`, for matplotlib's `savefig`."""
    return {KEY: hashlib.sha256(msgspec.json.encode(figures, order="sorted")).hexdigest(), "Software": None}


def figures_of(page: str) -> list[str]:
    """Return the lines of a page that belong to tables."""
    return [line for line in page.splitlines() if line.startswith("|")]


def subplots(size: tuple[float, float], *grid: int, **options: Any) -> tuple["Figure", Any]:
    """Return a new matplotlib figure of `size`, inches, and its axes."""
    from tormagd.view.drawing import Figure  # not every installation draws

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(*grid, **options)


def write_page(path: Path, sections: Iterable[str], folder: Path, pictures: Mapping[str, "Figure"]) -> None:
    page = "\n".join(section.rstrip() + "\n" for section in sections)
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in pictures.items():
        figure.savefig(folder / f"{name}.png", dpi=90, metadata=stamp(figures_of(page)))
    path.write_text(page, encoding="utf-8")


def table(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(columns)
    return "".join(f"| {' | '.join(line)} |\n" for line in [head, ["---"] * len(head), *rows])


def percent(share: float) -> str:
    return f"{100 * share:.1f}%"
