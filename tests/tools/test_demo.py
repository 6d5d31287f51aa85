"""What `make run` says: its verdict on made-up shows, its live line, and its table, the README's sample."""

import re
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from demo import live_touch, main as demo, pictures, show
from demo.pictures import touch_picture
from judge.following import Case, Followed, rehearse
from judge.touching import Touch
from machines.host import Host

from tormagd.config import Config, Rates
from tormagd.control.assembly.build import build_core
from tormagd.control.safety.codes import Fault, Limit
from tormagd.ctl.outcome import CommandError, Exit
from tormagd.scenes.measured import at_rates_of
from tormagd.scenes.scene import load_scene
from tormagd.simulation import patient
from tormagd.simulation.hand import FeltHand, parse_hand
from tormagd_client.messages import VERSION, Telemetry, Tick

README = Path(__file__).parents[2] / "README.md"
SCENE = load_scene("pulse")
QUIET = Host(steal=0.001, bare_kept=0.999, bare_worst_ms=3.0, waited={"daemon": 0.04})
STALLED, POOR = QUIET._replace(bare_worst_ms=92.0), QUIET._replace(bare_kept=0.93)
AXIS_S = np.linspace(0.0, 6.0, 601)
ASKED_N = 1.5 + 0.1 * np.sin(5.0 * AXIS_S)
CAUSE, REMEDY = "the device was 80 ms behind", "look for load"


def shown(**changes):
    group = {"hz": 500.0, "lateness_us": {"p50": 1, "p99": 2}, "exec_us": {"p50": 1, "p99": 2}}
    link = {"frames": 7, "lost": 0, "corrupt": 0, "repeated": 0}
    known = show.Shown(
        time_s=AXIS_S,
        asked_N=ASKED_N,
        rendered_N=ASKED_N + 0.01,
        gap_mm=AXIS_S,
        status={"rates": {"control": group, "inference": group}, "link": link},
        limits={"RATE": 0.1},
        exit_codes={"tormagd": 0},
        kept=0.996,
        worst_stall_ms=4.0,
        host=QUIET,
        core_share=0.3,
    )
    return known._replace(**changes)


def aborted(fault, host):
    with pytest.raises(show.ShowError) as caught:
        show.raise_fault({"faults": [fault], "fault_details": [{"cause": CAUSE, "remedy": REMEDY}]})
    return show.Aborted(caught.value, host)


def rehearsals():
    return dict.fromkeys(demo.CASES, Followed(AXIS_S, ASKED_N, ASKED_N + 0.01, AXIS_S, AXIS_S, {}))


MET, MISSED, HOST = demo.Verdict
FEW = 0.90 - demo.MARGIN
JUDGED = (
    *((shown(), MET, ""), (shown(host=STALLED), MET, ""), (shown(kept=0.85, host=POOR), MET, "")),
    *((shown(kept=FEW, host=POOR), HOST, "control rate"), (shown(kept=FEW), MISSED, "control rate")),
    *(
        (shown(host=host, **missed), HOST if host is STALLED else MISSED, named)
        for host in (QUIET, STALLED)
        for missed, named in (
            ({"rendered_N": ASKED_N + 0.05}, "RMS error"),
            ({"kept": 0.85}, "control rate"),
            ({"status": shown().status | {"link": shown().status["link"] | {"lost": 1}}}, "no frame lost"),
            ({"exit_codes": {"tormagd": 1}}, "every process ended in order"),
        )
    ),
)


@pytest.mark.parametrize(("show_", "verdict", "said"), JUDGED)
def test_a_show_is_judged_by_what_it_missed_and_what_its_host_took(show_, verdict, said):
    found, sentence = demo.judge(SCENE, show_)
    assert (found, bool(sentence)) == (verdict, verdict is not MET)
    assert said in sentence
    assert ("92 ms" in sentence) is (verdict is HOST and show_.host is STALLED)


@pytest.mark.parametrize("fault", list(Fault))
def test_a_fault_is_one_sentence_with_cause_and_remedy(fault):
    for host in (QUIET, STALLED):
        verdict, sentence = demo.judge(SCENE, aborted(fault, host))
        is_hosts = host is STALLED and fault in show.OF_TIME
        assert verdict is (HOST if is_hosts else MISSED)
        assert [said for said in (fault, CAUSE) if said not in sentence] == []
        assert is_hosts or REMEDY in sentence
        assert not re.search(r"[\n{}]", sentence)


@pytest.mark.parametrize(
    ("code", "host", "verdict"),
    [
        ("not_homed", STALLED, HOST),
        ("not_homed", QUIET, MISSED),
        ("not_allowed", STALLED, MISSED),
    ],
)
def test_a_homing_that_came_to_nothing_is_the_hosts_only_where_it_stood_still(code, host, verdict):
    ended = CommandError(Exit.REFUSED, code, "homing ended, but the device is not homed", "tormagctl status")
    with pytest.raises(show.ShowError) as caught:
        show.arm(SimpleNamespace(request=lambda _command: {"faults": []}, arm=Mock(side_effect=ended)))
    found, sentence = demo.judge(SCENE, show.Aborted(caught.value, host))
    assert found is verdict
    assert "homing ended" in sentence


@pytest.mark.parametrize("state", ["ENABLED", "DISABLED", "PAUSED", "FAULT"])
@pytest.mark.parametrize("limits", [(), *((limit,) for limit in Limit), tuple(Limit), tuple(Limit)[::-1]])
def test_the_live_line_fits_80_columns_and_hides_no_limit(limits, state):
    widest = Telemetry(
        v=VERSION, t_ns=1, seq=1, operating_state=state, is_homed=True, is_busy=False, setpoint_cf=1.7,
        governed_cf=1.7, measured_cf=-0.01, predicted_cf=1.7, field_mT=500.0, gap_mm=95.0, gap_setpoint_mm=95.0,
        measured_jp=(1.0, 1.0), skew_mm=0.0, duty=(0.0, 0.0), limits=tuple(map(str, limits)), faults=(),
        setpoint_age_ms=1.0, confidence=1.0, tick=Tick(lateness_us=1.0, exec_us=1.0),
    )  # fmt: skip
    line = show.live_line(widest, 1e6, 24.0)
    assert len(line) < 80, line
    left_out = re.search(r" \+(\d+)$", line)
    told = sum(re.search(rf"\b{limit}\b", line) is not None for limit in limits)
    assert told + (int(left_out[1]) if left_out else 0) == len(limits), line
    assert state == "ENABLED" or state in line
    assert told == len(limits) or len(limits) > 1 or state != "ENABLED", line


def test_the_readmes_sample_has_the_lines_that_are_printed(capsys):
    (sample,) = re.findall(r"```\n(force asked .*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    demo.print_forces(shown(), rehearsals())
    demo.print_timing(shown())
    # each line's first words: what two spaces end
    wanted, printed = (
        [re.split(r"(?<=\S) {2,}", line)[0].strip() for line in text.strip().splitlines()[1:]]
        for text in (sample, capsys.readouterr().out)
    )
    assert wanted == printed


@pytest.mark.parametrize(
    ("show_", "verdict", "exit_code"),
    [(shown(), MET, 0), (aborted("MEASUREMENT_STALE", STALLED), HOST, 3)],
)
def test_the_virtual_time_cases_are_shown_in_every_case(show_, verdict, exit_code, capsys):
    found, sentence = demo.judge(SCENE, show_)
    assert found is verdict
    ordered = {"torch": show_, "thesis": aborted("PLAN_FAILED", QUIET)}  # which decide nothing
    assert demo.conclude(SCENE, touched(), show_, rehearsals(), ordered, found, sentence) == exit_code
    printed = capsys.readouterr().out
    assert demo.judge(SCENE, ordered["thesis"])[1] in printed
    assert [case.label for case in demo.CASES if f"virtual time, {case.label}" not in printed] == []
    assert ("no verdict after 3 shows" in printed) == (exit_code == 3)


@pytest.fixture
def undrawn(monkeypatch) -> None:
    """Skip the picture, which costs more than the rest."""
    monkeypatch.setattr(pictures, "show_picture", Mock())


def test_a_virtual_time_case_that_fails_is_missed_whatever_the_host_did(capsys, undrawn):
    early = aborted("MEASUREMENT_STALE", QUIET)
    for verdict in (MET, HOST):
        assert demo.conclude(SCENE, early, shown(), dict(list(rehearsals().items())[1:]), {}, verdict, "") == 1
    assert "MISSED every case in virtual time done" in capsys.readouterr().out


@pytest.mark.parametrize("case", demo.CASES, ids=lambda case: case.label)
def test_every_case_of_the_demo_is_played(case: Case) -> None:
    times_s = np.arange(0.0, 0.5, 0.002)
    done = rehearse(Config(scene="pulse"), case, times_s, 1.5 + 0.1 * np.sin(2.0 * np.pi * times_s))
    assert np.isfinite(done.rendered_N).all()
    assert len(done.rendered_N) > 250


def touched(late_ms: int = 150) -> list[Touch]:
    waiting_N, columns = 0.9, ("handle_mm", "handle_mm_s", "kinetic_N", "force_N")
    lasts = round(1e3 * live_touch.begins_s(1)) - round(1e3 * live_touch.begins_s(0))
    rows = np.zeros(round(1e3 * live_touch.begins_s(3)), [(name, float) for name in columns])
    pushed_mm = np.minimum(0.02 * np.arange(lasts), live_touch.WALL_MM + 4.0)
    wall_N = live_touch.WALL_N_MM * np.maximum(pushed_mm - live_touch.WALL_MM, 0.0)
    rows["handle_mm"], rows["kinetic_N"] = 1.5, waiting_N
    for push in range(3):
        first = round(1e3 * live_touch.begins_s(push))
        rows["handle_mm"][first : first + lasts] += pushed_mm
        rows["kinetic_N"][first + late_ms : first + lasts] = np.maximum(wall_N[: lasts - late_ms], waiting_N)
    rows["force_N"] = rows["kinetic_N"]
    return live_touch.touches(rows, (0, 1, 2))


@pytest.fixture(autouse=True)
def _bounds(monkeypatch, tmp_path) -> None:
    """Bounds that are made up, and a folder of the test's own for what is written."""
    monkeypatch.setattr(demo, "RUN_DIR", tmp_path)
    for module in (demo, pictures):
        monkeypatch.setattr(module, "bounds", lambda: touched(100))


def test_what_is_ready_in_time_is_there_for_the_next_push() -> None:
    stroke_s = 2.0 * live_touch.HALF_S
    assert [live_touch.next_push(now_s) for now_s in (0.0, 9.0, 9.9, 10.0)] == [0, 0, 1, 1]
    assert live_touch.next_push(10.0 + stroke_s - live_touch.REST_S + live_touch.STAYS_S) == 1
    assert live_touch.begins_s(2) - live_touch.begins_s(1) == pytest.approx(stroke_s)


def test_the_hands_word_is_one_that_the_simulated_device_takes_and_begins_when_the_pushes_do() -> None:
    hand = parse_hand(live_touch.HAND)
    assert isinstance(hand, FeltHand)
    begins_s = live_touch.begins_s(1)
    assert hand.position_mm(begins_s) == pytest.approx(0.0, abs=1e-6)
    assert hand.position_mm(begins_s + 0.1) == pytest.approx(0.1 * live_touch.PUSH_MM_S)
    assert hand.position_mm(begins_s + live_touch.HALF_S - 1e-3) == live_touch.REACH_MM


def test_the_patients_words_are_what_it_takes() -> None:
    options = patient.parser().parse_args(live_touch.PATIENT)
    assert (options.wall_mm, options.stiffness_N_mm) == (live_touch.WALL_MM, live_touch.WALL_N_MM)
    assert (options.mode, options.delay_ms) == ("found", live_touch.ROUND_TRIP_MS / 2.0)


def test_a_push_is_found_in_what_the_device_wrote_and_told_as_late_as_it_was() -> None:
    for run, bound in zip(touched(), touched(100), strict=True):
        assert (run.time_s[0], run.depth_mm[0]) == (0.0, pytest.approx(-live_touch.WALL_MM))
        told = live_touch.figures(run, bound)
        assert (told["felt_later_ms"], told["bound_later_ms"]) == (pytest.approx(150.0), pytest.approx(100.0))
        assert told["wall_N"] == pytest.approx(told["felt_N"]) == 4.0 * live_touch.WALL_N_MM


def test_the_hands_lines_are_those_of_the_readme_and_its_picture_is_drawn(tmp_path) -> None:
    lines = demo.touch_told(SCENE, touched())
    (sample,) = re.findall(r"```\n(a wall of .*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    figure = re.compile(r"-?\d+\.\d\d N|\d+ ms (late|early)| +")
    assert [figure.sub("", line) for line in lines] == [figure.sub("", line) for line in sample.splitlines()]
    touch_picture(tmp_path / "touch.png", touched(), lines)
    assert (tmp_path / "touch.png").stat().st_size > 10_000


def test_each_touch_of_the_wall_is_felt_near_its_own_bound_and_never_before_it() -> None:
    runs, least = live_touch.in_virtual_time(live_touch.controller), live_touch.bounds()
    told = [live_touch.figures(*each) for each in zip(runs, least, strict=True)]
    for each in told:
        assert -3.0 <= each["felt_later_ms"] - each["bound_later_ms"] < 60.0
    assert told[0]["felt_later_ms"] > 600.0
    assert told[1]["felt_later_ms"] < 450.0
    assert told[2]["felt_later_ms"] < 110.0


def test_the_scene_of_the_hand_is_one_that_its_daemon_takes() -> None:
    scene = load_scene(str(live_touch.SCENE))
    config = at_rates_of(scene, Config(scene=str(live_touch.SCENE), rates=Rates(of_scene=True)))
    assert build_core(config, scene).portrait.min_N < scene.force.waiting_N < live_touch.FELT_N


def test_a_wall_that_is_never_felt_is_told_as_that() -> None:
    assert [live_touch.lateness(later_ms) for later_ms in (None, 0.0, 12.4, -3.0)] == [
        "never",
        "0 ms late",
        "12 ms late",
        "3 ms early",
    ]


def test_a_fault_of_the_hands_show_is_told_as_the_pulses_and_decides_nothing(tmp_path, undrawn) -> None:
    early = aborted("MEASUREMENT_STALE", STALLED)
    assert demo.touch_told(SCENE, early) == [demo.judge(SCENE, early)[1]]
    assert demo.conclude(SCENE, early, shown(), rehearsals(), {}, MET, "") == 0
    assert not (tmp_path / "touch.png").exists()
