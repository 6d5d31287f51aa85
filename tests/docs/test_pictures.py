"""Committed pictures are of the figures that are committed beside them."""

import json
import re
from pathlib import Path

import pytest
from PIL import Image

from tormagd.lab.pages import KEY, figures_of, stamp
from tormagd.scenes.measured import measured

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
GENERATED = ("inverse_trade.md", "learned_inverse.md", "reproduction.md")
SHOWN = re.compile(r"\]\(([\w/]+\.png)\)")
DRAWN = re.compile(r"--(?:picture|plot) docs/(\S+)")


def drawn():
    """Every picture that is drawn from committed figures, and these."""
    yield "images/scenes.png", measured().scenes
    for path in sorted(DOCS.glob("evidence/*.json")):
        evidence = json.loads(path.read_text(encoding="utf-8"))
        for picture in DRAWN.findall(evidence["command"]):
            evidence["figures"].pop("machine_us", None)  # of the machine, not of what was measured
            yield picture, evidence["figures"]
    summary = (ROOT / "README.md").read_text(encoding="utf-8").partition("\nforce asked")[2].partition("```")[0]
    yield "images/pulse.png", [line for line in summary.splitlines() if line.startswith("  ")]
    for name in GENERATED:
        page = (DOCS / name).read_text(encoding="utf-8")
        for picture in SHOWN.findall(page):
            yield picture, figures_of(page)


@pytest.mark.parametrize(("picture", "figures"), [pytest.param(*each, id=each[0]) for each in drawn()])
def test_a_picture_is_no_older_than_its_figures(picture, figures):
    with Image.open(DOCS / picture) as opened:
        assert opened.info[KEY] == stamp(figures)[KEY], "what writes the figures draws it anew"


def test_other_figures_have_another_stamp_and_other_words_the_same():
    page = "# A\n\n| mN |\n| --- |\n| 3 |\n"
    assert (
        stamp(figures_of(page))
        == stamp(figures_of(page + "\nMore words.\n"))
        != stamp(figures_of(page.replace("3", "4")))
    )
