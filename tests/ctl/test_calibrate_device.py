"""`calibrate --device`: what it asks teaches the daemon the device (in virtual time), and what it refuses."""

import contextlib
import json

import numpy as np
import pytest
from rendering.device_draws import drawn_device

from tormagd.assembly.build import build_core
from tormagd.closed_loop import ClosedLoop
from tormagd.config import Config
from tormagd.control.records import TimedSetpoint
from tormagd.ctl import calibrate_device
from tormagd.ctl.calibrate_device import ARRIVED_S, COLUMNS, STEP_S, judged, lesson
from tormagd.ctl.calibrate_run import Range
from tormagd.ctl.main import main
from tormagd.ctl.outcome import CommandError
from tormagd.simulation.device import VirtualDevice
from tormagd.simulation.hand import ReversingHand
from tormagd.simulation.parameters import load_plant

FORCES = Range(0.6, 2.0)


def played(loop, waveform):
    """The ticks of one waveform, as `Run.play` gives them."""
    start_s = loop.now_s
    rows = [
        (sample.time_s, sample.measured.force_N, sample.measured.handle.rate_mm_s)
        for sample in loop.run(
            waveform.duration_s, lambda now_s: TimedSetpoint(waveform.at(now_s - start_s).force_N, now_s, 0.25)
        )
    ]
    return dict(zip(COLUMNS, np.array(rows).T, strict=True))


# where a hand turns it is planned for as slow, by the model's Stribeck friction: sample 2's fades sooner
@pytest.mark.parametrize(
    ("plant", "mean_N", "worst_N"),
    [(load_plant("sample_2"), 0.04, 0.065), (drawn_device(57), 0.03, 0.06)],
    ids=["sample_2", "57"],
)
def test_what_is_asked_teaches_the_device(plant, mean_N: float, worst_N: float) -> None:
    """Synthetic devices, none of which chose a constant of the learning."""
    core = build_core(Config())
    loop = ClosedLoop(Config(), core.stepper(), core.planner(), VirtualDevice(plant, ReversingHand(2.0), seed=5))
    loop.arm()
    learning, judging = lesson(Range(core.portrait.min_N, 2.0))
    assert learning.duration_s + judging.duration_s < 60.0
    played(loop, learning)
    found = judged(played(loop, judging), judging, 0.0)
    assert found["steps"] == 6
    assert abs(found["mean_error_N"]) < mean_N
    assert abs(found["worst_error_N"]) < worst_N


def test_the_lesson_covers_the_range_and_nothing_else() -> None:
    for waveform in lesson(FORCES):
        asked = [waveform.at(t_s).force_N for t_s in np.arange(0.0, waveform.duration_s + 0.01, 0.01)]
        assert (min(asked), max(asked)) == pytest.approx((FORCES.least_N + 0.1, FORCES.most_N), abs=0.02)


def steps(error_N: float = 0.0, rate_mm_s: float = 40.0):
    """Ticks of the judging steps: the force arrives late, and then is off by `error_N`."""
    _, judging = lesson(FORCES)
    time_s = np.arange(0.0, judging.duration_s, 1e-3)
    late = time_s % STEP_S < ARRIVED_S
    asked = np.array([judging.at(t_s).force_N for t_s in time_s])
    values = (7.0 + time_s, np.where(late, 0.1, asked + error_N), np.full(len(time_s), rate_mm_s))
    return dict(zip(COLUMNS, values, strict=True))


def test_steps_are_judged_once_they_have_arrived_and_without_the_sensors_zero() -> None:
    _, judging = lesson(FORCES)
    found = judged(steps(error_N=0.05), judging, 0.02)
    assert found["mean_error_N"] == found["worst_error_N"] == pytest.approx(0.03)
    assert found["noise_N"] == pytest.approx(0.0, abs=1e-9)


def test_a_handle_that_hardly_moves_is_refused() -> None:
    _, judging = lesson(FORCES)
    with pytest.raises(CommandError, match="moved in 0% of the time"):
        judged(steps(rate_mm_s=1.0), judging, 0.0)


class Played:
    """A run whose ticks are the steps' whatever is asked."""

    def wait_for_handle(self, force_N: float) -> None:
        assert force_N > 0.6

    def play(self, waveform, bar):
        return steps(error_N=0.01)


@pytest.fixture
def calibrated(fake_daemon, monkeypatch, capsys):
    """Runs the command beside a daemon that says so; the exit code, and what it printed."""

    def run(**status):
        monkeypatch.setattr(calibrate_device, "armed", lambda *_: contextlib.nullcontext(Played()))
        monkeypatch.setattr(calibrate_device, "KEPT_WITHIN_S", 0.2)
        fake_daemon.says(**{"setpoint_age_ms": None, "least_N": 0.6} | status)
        code = main(["--endpoint", fake_daemon.control, "--json", "calibrate", "--yes", "--device"])
        return code, json.loads(capsys.readouterr().out)

    return run


KEPT = {"is_used": True, "age_s": 0.1, "refusal": "", "folder": "/profiles"}


def test_a_device_is_learned_judged_and_kept(calibrated) -> None:
    code, answer = calibrated(profile=KEPT)
    result = answer["result"]
    assert (code, result["scale"], result["profile"], result["steps"]) == (0, 1.0, "/profiles", 6)
    assert result["worst_error_N"] == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("status", "told"),
    [
        ({"profile": KEPT | {"folder": "", "refusal": "no folder is named for profiles"}}, "not_kept"),
        ({"profile": KEPT | {"refusal": "/profiles: Read-only file system: nothing was kept"}}, "not_kept"),
        ({"profile": KEPT | {"age_s": 900.0}}, "not_kept"),
        (
            {"profile": KEPT, "limit_details": [{"code": "SENSOR", "cause": "it lies", "remedy": "look"}]},
            "sensor_doubted",
        ),
    ],
    ids=["no folder", "a full disk", "an old one only", "a sensor that lies"],
)
def test_what_taught_nothing_is_refused(calibrated, status, told) -> None:
    code, answer = calibrated(**status)
    assert (code, answer["error"]["code"]) == (1, told)
