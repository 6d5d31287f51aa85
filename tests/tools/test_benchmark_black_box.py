"""What the black box costs: the figures are of what the daemon writes down."""

import argparse

import pytest
from benchmarks import black_box

from tormagd.recording.keeper import MOST_BYTES


def test_half_a_minute_fits_into_the_ring(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(black_box, "PULSE_S", 0.4)
    monkeypatch.setattr(black_box, "ROUNDS", 1)
    result = black_box.measure(argparse.Namespace())
    assert result["tick_us"] > 0.0
    assert result["dropped"] == 0
    assert 300 < result["bytes_per_tick"] < 700
    assert result["ring_MB"] * 1e6 < MOST_BYTES
    black_box.print_table(result)
    assert "MB in half a minute" in capsys.readouterr().out
