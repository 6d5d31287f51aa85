"""What the machine is measured with."""

import asyncio
import json
from functools import partial
from typing import Any

import pytest
import uvloop

from firmware_protocol.build import settle
from tormagd.config import Config, RealTime
from tormagd.control.assembly.build import Core
from tormagd.ground import machine_loop
from tormagd.headroom import __main__ as program
from tormagd.headroom.bare_timer import lateness

pytestmark = pytest.mark.usefixtures("usual_slices")


def test_the_reference_loop_is_what_it_was() -> None:
    left_mm, right_mm, crc = machine_loop.work()
    assert (left_mm.hex(), right_mm.hex(), crc) == ("0x1.cc52cff28ee7bp-1", "0x1.c5ef2fa2304bdp-1", 770)
    assert machine_loop.machine_us(3) > 0.0


def test_a_bare_timer_counts_every_beat_that_it_had_or_missed() -> None:
    found = uvloop.run(lateness(RealTime(), 1_000, 0.1))
    assert len(found.beats_us) + found.missed >= 100
    assert len(found.beats_us) <= 100
    assert min(found.beats_us) >= 0.0
    assert found.not_granted == []


def test_what_the_kernel_refuses_is_said() -> None:
    found = uvloop.run(lateness(RealTime(cpus=(4_095,)), 1_000, 0.02))
    assert len(found.not_granted) == 1
    assert "realtime.cpus" in found.not_granted[0]


def test_the_calls_are_those_of_the_closed_loop_and_can_be_made_again(core: Core) -> None:
    made: Any = program.calls(Config(), core, 0.05)
    steps, plans = made
    assert (len(steps), len(plans)) == (50, 50)
    # each of these plans is the one that the step was given in the loop
    planned = [plan() for plan in plans]
    assert planned == [step.args[2] for step in steps]
    numbers = [plan.number for plan in planned]
    assert numbers == list(range(numbers[0], numbers[0] + 50))
    again, _ = program.calls(Config(), core, 0.05)
    outputs = [step() for step in steps]
    assert outputs == [step() for step in again]
    assert any(output.left_duty != 0.0 for output in outputs)


def test_each_call_is_made_once_in_its_own_beat() -> None:
    made: list[str] = []
    steps, plans = ([partial(made.append, name)] * 7 for name in ("step", "plan"))
    found = asyncio.run(program.core_cost(steps, plans, 1_000))
    assert made == ["plan", "step"] * 7
    assert [len(each) for each in found] == [7, 7]


def test_the_program_prints_every_figure(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(program, "TIMER_S", 0.05)
    monkeypatch.setattr(program, "CORE_S", 0.05)
    assert program.main([]) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found) == {"machine_us", "build", "step_us", "plan_us", "bare"}
    assert set(found["step_us"]) == set(found["bare"]["lateness_us"]) == {"mean", "p50", "p99", "p999", "max"}
    assert (found["bare"]["rate_hz"], found["build"]) == (1_000, str(settle()))


def test_a_configuration_that_does_not_fit_is_refused(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "slow.toml"
    path.write_text("[rates]\ncontrol_hz = 100\ninference_hz = 83\n")
    assert program.main(["--config", str(path)]) == 2
    assert "rates.control_hz = 100" in capsys.readouterr().err
