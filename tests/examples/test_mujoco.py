"""The guidewire in MuJoCo, two seconds of it before a daemon that is played."""

import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco")
guidewire = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[2] / "examples" / "mujoco" / "guidewire.py")))
ROUTE, LESION_MM = "30:0,20:30,32:0", 52.0
PUSH_MM_S, SECONDS = 32.0, 2.0


class Played:
    """A daemon whose handle is pushed on, and feels what is published."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.published: list[Any] = []

    def motions(self) -> list[Any]:
        return [SimpleNamespace(handle_mm=PUSH_MM_S * self.now_s)]

    def telemetry(self) -> list[Any]:
        return [SimpleNamespace(measured_cf=self.published[-1][0])] if self.published else []

    def publish(self, force_N: float, **fields: Any) -> None:
        self.published.append((force_N, fields["withdraw_cf"], fields["contact"]))

    def wait(self, _: float) -> None:
        self.now_s += guidewire.STEP_S


def test_the_wire_meets_a_lesion_which_the_estimator_finds_and_is_drawn(tmp_path: Path) -> None:
    daemon, route = Played(), guidewire.route_of(ROUTE)
    wire = guidewire.Guidewire(route, 0.2, 0.1)
    rows, shapes_mm = guidewire.run(daemon, wire, SECONDS, lambda: daemon.now_s, daemon.wait)
    _, place_mm, there_N, _, _ = np.array(rows, float).T
    assert len(rows) == len(daemon.published) == round(SECONDS / guidewire.STEP_S)
    assert min(force_N for force_N, *_ in daemon.published) >= 0.0
    assert there_N[place_mm < LESION_MM].max() < 0.4
    spring_N = guidewire.SCALE * 0.1 * (PUSH_MM_S * SECONDS - LESION_MM)
    assert there_N.max() == pytest.approx(spring_N, rel=0.1)
    known = [contact for *_, contact in daemon.published if contact is not None]
    assert known[-1].handle_mm == pytest.approx(LESION_MM, abs=1.0)
    guidewire.draw(str(tmp_path / "wire.png"), route, rows, shapes_mm)
    assert (tmp_path / "wire.png").stat().st_size > 10_000


def test_a_wire_that_draws_back_leaves_the_lesion_at_once() -> None:
    wire = guidewire.Guidewire(guidewire.route_of(ROUTE), 0.2, 0.1)
    way_mm = np.concatenate([np.arange(0.0, LESION_MM + 14.0, 0.12), np.arange(LESION_MM + 14.0, 40.0, -0.12)])
    there_N = np.array([wire.push(float(place_mm)) for place_mm in way_mm])
    assert there_N.max() > 1.0
    assert there_N.min() > -0.1


@pytest.mark.parametrize("text", ["", "40", "40:nan", "5:90", "40:0,1e9:0", "10:0", "100:0,100:0", "-40:0"])
def test_a_route_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"route|unpack|convert"):
        guidewire.route_of(text)
