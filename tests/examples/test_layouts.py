"""The layouts for PlotJuggler and Foxglove show what recordings and telemetry have, by the names that those give it."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from tormagd.recording.writer import TELEMETRY_TOPIC, TICK_KINDS, TICKS_TOPIC, plain_schema, tick_schema
from tormagd_client.messages import Telemetry

EXAMPLES = Path(__file__).parents[2] / "examples"
SCHEMAS = {TELEMETRY_TOPIC: plain_schema(Telemetry), TICKS_TOPIC: tick_schema(TICK_KINDS)}
PAIRS = ("duty", "measured_jp")
"Lists of a number for each carriage; the others are of codes, as many as there are."


def fields(schema: dict[str, Any], prefix: str, join: str) -> Iterator[tuple[str, str]]:
    """Everything in a message and its type: `prefix`, `join` and the name, and of a list each item's number."""
    for name, inner in schema.get("properties", {}).items():  # what a map holds is named by who publishes
        path = f"{prefix}{join}{name}"
        if inner["type"] == "object":
            yield from fields(inner, path, join)
        elif inner["type"] == "array":
            yield from ((f"{path}[{k}]", inner["items"]["type"]) for k in range(2 if name in PAIRS else 9))
        else:
            yield path, inner["type"]


def leaves(node: str | dict[str, Any]) -> Iterator[str]:
    """The panels of a Foxglove layout: a panel, or two parts that share a place."""
    if isinstance(node, str):
        yield node
        return
    assert node["direction"] in ("row", "column")
    assert 0 < node["splitPercentage"] < 100
    yield from leaves(node["first"])
    yield from leaves(node["second"])


@pytest.mark.parametrize(
    ("name", "topics"),
    [("plotjuggler_recording.xml", SCHEMAS), ("plotjuggler_live.xml", {"": plain_schema(Telemetry)})],
)
def test_plotjuggler_finds_its_curves(name: str, topics: dict[str, dict[str, Any]]) -> None:
    """It names a series by topic, slash and field, and shows numbers; a message of one frame has no topic."""
    known = {path: kind for topic, schema in topics.items() for path, kind in fields(schema, topic, "/")}
    root = ElementTree.parse(EXAMPLES / name).getroot()
    curves = [curve.attrib["name"] for curve in root.iter("curve")]
    assert len(curves) >= 10
    assert {known.get(curve) for curve in curves} <= {"number", "integer", "boolean"}, set(curves) - set(known)
    for plot in root.iter("plot"):
        shown = [curve.attrib["color"] for curve in plot.iter("curve")]
        assert 0 < len(shown) == len(set(shown))
    for splitter in root.iter("DockSplitter"):
        parts = [float(size) for size in splitter.attrib["sizes"].split(";")]
        assert len(splitter) == len(parts) == int(splitter.attrib["count"])
        assert sum(parts) == pytest.approx(1.0)


def test_foxglove_finds_its_paths() -> None:
    """A path is the topic and, behind a dot, the field."""
    layout = json.loads((EXAMPLES / "foxglove.json").read_text(encoding="utf-8"))
    known = {path: kind for topic, schema in SCHEMAS.items() for path, kind in fields(schema, topic, ".")}
    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])
    for panel, config in layout["configById"].items():
        asked = [path["value"] for path in config.get("paths", [])]
        assert all(path in known for path in asked), (panel, asked)
        if panel.startswith("Plot!"):
            assert {known[path] for path in asked} == {"number"}
        assert asked or config["topicPath"] in SCHEMAS


def test_the_pairs_are_pairs() -> None:
    for name in PAIRS:
        assert "tuple[float, float]" in str(Telemetry.__annotations__[name])
