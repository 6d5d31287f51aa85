from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, strategies as st

from tormagd.ctl.outcome import CommandError
from tormagd.ctl.send import held_back
from tormagd.ctl.waveform import SHAPES, beat, read_csv, shape
from tormagd.ground.table import TableError
from tormagd_client.messages import MAX_PREVIEW_SAMPLES, Setpoint, Status


@pytest.fixture
def published(fake_daemon: Any, ctl: Any) -> Any:
    def run(*arguments: str) -> tuple[dict[str, Any], list[Setpoint]]:
        before = len(fake_daemon.setpoints)
        result = ctl(*fake_daemon.at, "--json", "send", *arguments).ended(0).result
        return result, fake_daemon.arrived(before + result["sent"])

    return run


def after_s(setpoint: Setpoint, first: Setpoint) -> float:
    return (setpoint.stamp_ns - first.stamp_ns) * 1e-9


@pytest.fixture
def file(tmp_path):
    return tmp_path / "task.csv"


def test_every_setpoint_arrives_from_the_first_on(published):
    result, arrived = published(
        "ramp",
        "--duration",
        "0.3",
        "--rate",
        "200",
        "--from-N",
        "1",
        "--to-N",
        "2",
        "--source",
        "me",
        "--valid-for-ms",
        "70",
    )
    assert result["sent"] + result["skipped"] == 61
    assert (len(arrived), arrived[0].servo_cf, arrived[-1].servo_cf) == (result["sent"], 1.0, 2.0)
    assert all(b.seq > a.seq and b.stamp_ns > a.stamp_ns for a, b in pairwise(arrived))
    assert {(each.source, each.valid_for_ms) for each in arrived} == {("me", 70.0)}
    # the force belongs to the setpoint's own deadline
    due_N = [1.0 + after_s(setpoint, arrived[0]) / 0.3 for setpoint in arrived]
    assert [setpoint.servo_cf for setpoint in arrived] == pytest.approx(due_N, abs=1e-6)
    # the count has no holes: what was left out was never sent
    assert [setpoint.seq for setpoint in arrived] == list(range(result["sent"]))


@pytest.mark.parametrize(("rate_hz", "preview_ms", "count"), [(100, 50, 5), (320, 800, MAX_PREVIEW_SAMPLES)])
def test_a_preview_is_what_will_be_sent(published, rate_hz, preview_ms, count):
    options = ("--duration", "0.2", "--rate", str(rate_hz), "--preview-ms", str(preview_ms))
    _, arrived = published("sine", *options)
    forces = {round(rate_hz * after_s(setpoint, arrived[0])): setpoint.servo_cf for setpoint in arrived}
    for setpoint in arrived:
        assert (len(setpoint.preview_N), setpoint.preview_dt_ms) == (count, 1e3 / rate_hz)
        for after, force in enumerate(setpoint.preview_N, start=1):
            later = min(round(rate_hz * after_s(setpoint, arrived[0])) + after, 0.2 * rate_hz)
            assert force == pytest.approx(forces.get(later, force), abs=1e-9)


@pytest.mark.parametrize(
    ("content", "options", "count", "last"),
    [
        ("t_s,force_N,displacement_mm,rate_mm_s\n10,1,0,5\n10.1,2,2,5\n", (), 11, (2.0, 2.0, 5.0)),
        ("t_s,force_N\n0,1\n100,2\n", ("--duration", "0.05"), 6, (1.0005, None, None)),
    ],
    ids=["with its handle motion", "cut short by duration"],
)
def test_a_file_is_sent(published, file, content, options, count, last):
    file.write_text(content)
    result, (*_, sent) = published(str(file), "--rate", "100", *options)
    assert result["sent"] + result["skipped"] == count
    assert (sent.servo_cf, sent.displacement_mm, sent.rate_mm_s) == pytest.approx(last)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("", "no numbers stand right below a row of names"),
        ("t_s,force_N\n", "no numbers stand right below a row of names"),
        ("0,1\n1,2\n", "no numbers stand right below a row of names"),
        ("t_s,force_N\n0,1\n", "1 rows"),
        ("time,force_N\n0,1\n1,1\n", "'time' states no unit: time_s is in s, ms, us, min, h:m:s"),
        ("time,force_N\n0,1\n1,1\n", "state --time-column time:UNIT"),
        ("t [s],force [lb]\n0,1\n1,1\n", "'force [lb]' has the unit 'lb': force_N is in N, mN"),
        ("t_s,pressure\n0,1\n1,1\n", "no column is force_N (force, load, kraft, F)"),
        ("t_s,force_N,t_s\n0,1,0\n1,1,1\n", "'t_s' and 't_s' may both be time_s"),
        ("t_s,force_N\n0,1\n1,nan\n2,1\n", "row 3 lacks a value"),
        ("t_s;force_N\n1;1,500\n2;2,500\n", "'1,500' may be a thousand or a fraction"),
        ("t_s;force_N\n1;1,5\n2;2.5\n", "two decimal marks"),
        ("t_s,force_N\n0,00,1,5\n0,01,1,6\n", "decimal commas need ; or tab"),
        ("Zeit,force_N\n10:05,1\n10:06,1\n", "states no unit: time_s is in s"),
        ("t_s,force_N\n0,1\ninf,1\n", "row 3, t_s = 'inf'"),
        ("t_s,force_N\n0,1\n1,-0.5\n", "row 3, force_N = -0.5: allowed is 0..1000 N; a brake cannot push"),
        ("t_s,force_N\n0,1\n1,1e9\n", "row 3, force_N = 1e+09"),
        ("t_s,force_N\n-1e308,1\n1e308,1\n", "row 2, time_s = -1e+308: allowed is -1e+10..1e+10 s"),
        ("t_s,force_N,displacement_mm\n0,1,0\n1,1,1e10\n", "row 3, displacement_mm = 1e+10: allowed is 0..2 mm"),
        ("t_s,force_N,rate_mm_s\n0,1,0\n1,1,-1e5\n", "row 3, rate_mm_s = -100000: allowed is -300..300 mm/s"),
        ("t_s,force_N\n0,1\n0,2\n", "row 3, time_s = 0: allowed is above"),
        (
            "t_s,force_N\n0,1\n5e-324,2\n",
            "row 3, time_s = 4.94066e-324: allowed is above the row before, 0, by 1e-09 s",
        ),
        ("t_s,force_N\n1,1\n0,2\n", "row 3, time_s = 0: allowed is above"),
        ("t_s,force_N\n0,1\n1\n", "row 3 has 1 values: allowed is 2"),
        ("t_s,force_N\n0,1\n1,1,5\n", "row 3 has 3 values"),
        ("t_s,force_N\n0,1\n1,1_5\n", "row 3, force_N = '1_5'"),
        ("t_s,force_N\n0,1\n1,\n", "row 3 lacks one"),
        ('t_s,force_N\n0,"1\n', "not CSV"),
        ("t_s;force_N\n0;1\n", "1 rows"),
        ("t_s,force_N\n0," + "9" * 200_000 + "\n", "not CSV"),
        (b"t_s,force_N\n0,\x81\n", "neither UTF-8 text"),
        (b"\x00\x01\x02", "task.csv"),
    ],
)
def test_a_faulty_file_is_refused_by_row_column_and_value(tmp_path, ctl, content, named, file):
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert named in ctl("--json", "send", str(file)).ended(2).error["message"]


@given(st.binary(max_size=300))
def test_any_bytes_are_a_waveform_or_refused(tmp_path_factory, data):
    file = Path(tmp_path_factory.getbasetemp()) / "any.csv"
    file.write_bytes(b"t_s,force_N\n" + data)
    try:
        waveform = read_csv(file)
    except TableError:
        return
    assert 0.0 <= waveform.at(waveform.duration_s / 2).force_N <= 1_000.0


@given(
    st.lists(st.tuples(st.floats(1e-3, 10.0), st.floats(0.0, 10.0)), min_size=2, max_size=20),
    st.floats(-0.5, 1.5),
)
def test_between_rows_the_force_is_on_the_straight_line(tmp_path_factory, steps, share):
    spacing, forces = zip(*steps, strict=True)
    times = np.cumsum(spacing).tolist()
    file = Path(tmp_path_factory.getbasetemp()) / "line.csv"
    file.write_text("t_s,force_N\n" + "".join(f"{t!r},{f!r}\n" for t, f in zip(times, forces, strict=True)))
    waveform = read_csv(file)
    t_s = share * waveform.duration_s
    assert waveform.at(t_s).force_N == pytest.approx(np.interp(times[0] + t_s, times, forces), abs=1e-6)


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_stay_between_their_two_forces_and_reach_both(name):
    waveform = shape(name, 1.2, 1.8, 2.0, 4.0)
    forces = [waveform.at(k / 1_000).force_N for k in range(4_001)]
    assert (min(forces), max(forces)) == pytest.approx((1.2, 1.8), abs=1e-3)


@pytest.mark.parametrize(
    ("name", "frequency_hz", "forces_N"),
    [
        ("step", 1.0, {1.999: 1.0, 2.0: 2.0}),
        ("sine", 2.0, {0.25: 2.0, 0.5: 1.0}),
        ("pulse", 0.5, dict.fromkeys((0.5, 2.5), 1.0 + beat(0.25))),
    ],
)
def test_shapes_have_their_frequency_and_their_step(name, frequency_hz, forces_N):
    waveform = shape(name, 1.0, 2.0, frequency_hz, 4.0)
    assert [waveform.at(t_s).force_N for t_s in forces_N] == pytest.approx([*forces_N.values()])


# -- whether its setpoints were rendered -------------------------------------------------------------------------------


EXPLAINED = {
    "STALE": "setpoints of 'me' come 300 ms late",
    "OTHER_SOURCE": "'me' sends setpoints too, and 'robot' holds the brake",
    "F_MAX": "more force was asked for than the closed gap gives",
}


@pytest.fixture
def seen(status_with: Any, source_with: Any) -> Any:
    def made(source: dict[str, Any] | None = None, **changes: Any) -> Status:
        by_source = {} if source is None else {"me": source_with(**source)}
        setpoints = {"by_source": by_source, "newest_source": "robot"}
        details = [{"code": code, "cause": cause, "remedy": "do this"} for code, cause in EXPLAINED.items()]
        return msgspec.convert(status_with(**{"setpoints": setpoints, "limit_details": details} | changes), Status)

    return made


@pytest.mark.parametrize(
    ("state", "limits", "is_over", "code"),
    [
        ("holds", [], False, ""),
        ("holds", ["F_MIN", "RATE", "TAKEOVER"], False, ""),
        ("stale", ["RANGE"], True, ""),
        ("refused", [], True, "other_source"),
    ],
)
def test_what_is_taken_while_enabled_is_rendered_and_when_sending_is_over_the_newest_may_be_stale(
    seen, state, limits, is_over, code
):
    held = held_back(seen({"state": state}, limits=limits), "me", is_over=is_over)
    assert (held.code if held else "") == code


@pytest.mark.parametrize(
    ("source", "changes", "code", "exit_code", "said", "hint"),
    [
        ({}, {"operating_state": "DISABLED"}, "disabled", 1, "the device is DISABLED", "tormagctl arm"),
        ({}, {"operating_state": "DISABLED", "is_homed": False}, "disabled", 1, "DISABLED", "tormagctl arm"),
        ({}, {"operating_state": "PAUSED"}, "paused", 1, "PAUSED", "tormagctl resume"),
        ({}, {"operating_state": "FAULT", "faults": ["SKEW"]}, "fault", 4, "in FAULT: SKEW", "tormagctl arm"),
        (None, {}, "not_heard", 1, "nothing of 'me': too much", "status"),
        ({"state": "refused"}, {}, "other_source", 1, "'robot' holds the brake", "do this"),
        ({"state": "stale"}, {}, "stale", 1, "300 ms late", "do this"),
        ({"state": "stale"}, {"limit_details": []}, "stale", 1, "STALE: it holds the force of 'me' back", "status"),
        ({}, {"limits": ["F_MAX"]}, "f_max", 1, "more force was asked", "do this"),
        ({}, {"limits": ["RANGE"]}, "range", 1, "RANGE: it holds", "status"),
    ],
)
def test_what_holds_a_force_back_is_named_with_its_remedy(seen, source, changes, code, exit_code, said, hint):
    with pytest.raises(CommandError) as held:
        raise held_back(seen(source, **changes), "me") or AssertionError("rendered")
    assert (held.value.code, held.value.exit_code) == (code, exit_code)
    assert said in held.value.message
    assert hint in held.value.hint


@pytest.fixture
def sent(fake_daemon: Any, ctl: Any) -> Any:
    return lambda: ctl(*fake_daemon.at, "--json", "send", "step", "--duration", "0.4", "--rate", "50")


def test_what_was_rendered_is_told(fake_daemon, sent):
    fake_daemon.says(limits=["RATE"])
    done = sent().ended(0)
    expected = {"accepted": done.result["sent"], "rendered_share": 1.0, "limits": ["RATE"]}
    assert (done.err, done.result) == ("", done.result | expected)


@pytest.mark.parametrize(
    ("changes", "expected", "code", "says"),
    [
        ({"operating_state": "DISABLED"}, 1, "disabled", "rendered 0% of the time: the device is DISABLED"),
        ({"operating_state": "PAUSED"}, 1, "paused", "PAUSED"),
        ({"operating_state": "FAULT", "faults": ["SKEW"]}, 4, "fault", "in FAULT: SKEW"),
    ],
)
def test_what_is_not_rendered_is_no_success(fake_daemon, sent, changes, expected, code, says):
    fake_daemon.says(**changes)
    done = sent().ended(expected)
    assert says in done.error["message"]
    assert says[-10:] in done.err
    assert (done.result, done.error["code"], bool(fake_daemon.setpoints)) == (None, code, expected == 1)


def test_setpoints_may_wait_for_enable_but_not_for_what_comes_after(fake_daemon, sent):
    disabled, enabled, paused = ({"operating_state": state} for state in ("DISABLED", "ENABLED", "PAUSED"))
    fake_daemon.says_in_turn(disabled, disabled, enabled)
    done = sent().ended(0)
    assert 0.0 < done.result["rendered_share"] < 1.0
    assert done.err.count("not rendered: the device is DISABLED") == 1
    fake_daemon.setpoints.clear()
    fake_daemon.says_in_turn(enabled, enabled, paused, enabled)
    assert sent().ended(1).error["code"] == "paused"


def test_setpoints_that_nobody_took_are_no_success(fake_daemon, sent):
    fake_daemon.taken_share = 0.0
    assert sent().ended(1).error["code"] == "not_heard"
    # another publisher of the same name, or a loss
    fake_daemon.taken_share = 0.5
    fake_daemon.setpoints.clear()
    assert sent().ended(1).error["code"] == "not_taken"


@pytest.mark.parametrize(
    ("arguments", "asked"),
    [
        (("step", "--to-N", "5.0000000001"), "1.4..5.0000000001"),
        (("step", "--from-N", "0.4", "--to-N", "6"), "0.4..6"),
        (("FILE",), "1..7"),
    ],
)
def test_what_the_scene_does_not_allow_is_not_sent(fake_daemon, ctl, tmp_path, arguments, asked, file):
    file.write_text("t_s,force_N\n0,1\n1,7\n")
    told = [str(file) if each == "FILE" else each for each in arguments]
    error = ctl(*fake_daemon.at, "--json", "send", *told).ended(1).error
    assert error["message"] == f"{asked} N is asked: allowed is 0.5..2 N in scene pulse; nothing was sent"
    assert (error["code"], fake_daemon.setpoints) == ("out_of_range", [])


def test_blind_it_asks_nothing_and_says_that_it_does_not_know(fake_daemon, ctl):
    fake_daemon.says(operating_state="DISABLED")
    done = ctl(*fake_daemon.at, "send", "step", "--duration", "0.05", "--blind").ended(0)
    assert ("whether they were taken is not known" in done.out, fake_daemon.commands) == (True, [])


def test_a_key_that_may_only_publish_is_told_how(run_dir, tmp_path, ctl):
    ctl("keys", "generate", str(tmp_path), "--publish", "robot").ended(0)
    config = tmp_path / "client.toml"
    curve = f'client_secret = "{tmp_path}/robot.key_secret"\nserver_public = "{tmp_path}/server.key"\n'
    config.write_text(f'[endpoints]\ncontrol = "ipc://{run_dir}/control"\n[endpoints.curve]\n{curve}')
    told = ctl("--config", str(config), "--wait", "0.05", "send", "step").ended(3).err
    assert "with a key that may only publish: --blind" in told


def test_a_daemon_that_takes_setpoints_and_does_not_answer_is_not_reached(fake_daemon, run_dir, tmp_path, ctl):
    config = tmp_path / "tormagd.toml"
    config.write_text(f'[endpoints]\ncontrol = "ipc://{run_dir}/nobody"\nsetpoint = "ipc://{run_dir}/setpoint"\n')
    ctl("--config", str(config), "--wait", "0.1", "send", "step").ended(3)
    assert fake_daemon.setpoints == []
