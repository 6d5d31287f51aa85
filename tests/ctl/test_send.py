from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from tormagd.ctl.main import main
from tormagd.ctl.waveform import SHAPES, read_csv, shape
from tormagd.force_file import ForceFileError
from tormagd_client.messages import Setpoint


def send(daemon, ctl, *arguments: str) -> dict:
    return ctl("--endpoint", daemon.control, "--json", "send", *arguments).ended(0).result


def wait_for(daemon, count: int) -> None:
    """Until the fake daemon has read what was sent: it answers a request only after an earlier round of reading."""
    for _ in range(200):
        if len(daemon.setpoints) >= count:
            return
        assert main(["--endpoint", daemon.control, "--json", "status"]) == 0
    raise AssertionError(f"{len(daemon.setpoints)} of {count} setpoints arrived")


def after_s(setpoint: Setpoint, first: Setpoint) -> float:
    """How long after the first one it is meant."""
    return (setpoint.stamp_ns - first.stamp_ns) * 1e-9


def test_every_setpoint_arrives_from_the_first_on(fake_daemon, ctl):
    result = send(fake_daemon, ctl, "ramp", "--duration", "0.3", "--rate", "200", "--from-N", "1", "--to-N", "2")
    wait_for(fake_daemon, result["sent"])
    arrived = fake_daemon.setpoints
    assert result["sent"] + result["skipped"] == 61
    assert (len(arrived), arrived[0].servo_cf, arrived[-1].servo_cf) == (result["sent"], 1.0, 2.0)
    assert all(b.seq > a.seq and b.stamp_ns > a.stamp_ns for a, b in pairwise(arrived))
    # the force belongs to the setpoint's own deadline, whatever was left out
    for setpoint in arrived:
        assert setpoint.servo_cf == pytest.approx(1.0 + after_s(setpoint, arrived[0]) / 0.3, abs=1e-6)
    # who counts what is missing finds nothing: what was left out was never sent
    assert [setpoint.seq for setpoint in arrived] == list(range(result["sent"]))


def test_a_second_run_of_the_same_source_is_newer(fake_daemon, ctl):
    options = ("step", "--duration", "0.02", "--source", "me", "--valid-for-ms", "70")
    first = send(fake_daemon, ctl, *options)
    second = send(fake_daemon, ctl, *options)
    wait_for(fake_daemon, first["sent"] + second["sent"])
    numbers = [(setpoint.session, setpoint.seq) for setpoint in fake_daemon.setpoints]
    assert numbers[0][1] == numbers[first["sent"]][1] == 0
    assert numbers == sorted(set(numbers))
    assert {(s.source, s.valid_for_ms) for s in fake_daemon.setpoints} == {("me", 70.0)}


def test_a_preview_is_what_will_be_sent(fake_daemon, ctl):
    wait_for(
        fake_daemon,
        send(fake_daemon, ctl, "sine", "--duration", "0.2", "--rate", "100", "--preview-ms", "50")["sent"],
    )
    arrived = fake_daemon.setpoints
    forces = {round(100.0 * after_s(setpoint, arrived[0])): setpoint.servo_cf for setpoint in arrived}
    for setpoint in arrived:
        assert (len(setpoint.preview_N), setpoint.preview_dt_ms) == (5, 10.0)
        for after, force in enumerate(setpoint.preview_N, start=1):
            later = min(round(100.0 * after_s(setpoint, arrived[0])) + after, 20)
            assert force == pytest.approx(forces.get(later, force), abs=1e-9)
    assert (
        "--preview-ms = 300"
        in ctl(*fake_daemon.at, "send", "sine", "--rate", "1000", "--preview-ms", "300").ended(2).err
    )


def test_a_file_is_sent_with_its_handle_motion(fake_daemon, ctl, tmp_path):
    file = tmp_path / "task.csv"
    file.write_text("t_s,force_N,displacement_mm,rate_mm_s\n10,1,0,5\n10.1,2,2,5\n")
    result = send(fake_daemon, ctl, str(file), "--rate", "100")
    wait_for(fake_daemon, result["sent"])
    assert result["sent"] + result["skipped"] == 11
    last = fake_daemon.setpoints[-1]
    assert (last.servo_cf, last.displacement_mm, last.rate_mm_s) == pytest.approx((2.0, 2.0, 5.0))


def test_duration_cuts_a_file_short(fake_daemon, ctl, tmp_path):
    file = tmp_path / "task.csv"
    file.write_text("t_s,force_N\n0,1\n100,2\n")
    result = send(fake_daemon, ctl, str(file), "--rate", "100", "--duration", "0.05")
    assert result["sent"] + result["skipped"] == 6


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("", "no column t_s"),
        ("t_s,force_N\n", "0 rows"),
        ("t_s,force_N\n0,1\n", "1 rows"),
        ("time,force_N\n0,1\n1,1\n", "no column t_s (it is 'time,force_N')"),
        ("t_s,force_N,mood\n0,1,2\n1,1,2\n", "column 'mood'"),
        ("t_s,force_N,t_s\n0,1,0\n1,1,1\n", "t_s is there twice"),
        ("t_s,force_N\n0,1\n1,nan\n", "row 3, force_N = 'nan'"),
        ("t_s,force_N\n0,1\ninf,1\n", "row 3, t_s = 'inf'"),
        ("t_s,force_N\n0,1\n1,-0.5\n", "row 3, force_N = -0.5: allowed is 0..1000 N"),
        ("t_s,force_N\n0,1\n1,1e9\n", "row 3, force_N = 1e9"),
        ("t_s,force_N\n-1e308,1\n1e308,1\n", "row 2, t_s = -1e308: allowed is -1e+10..1e+10 s"),
        ("t_s,force_N,displacement_mm\n0,1,0\n1,1,1e10\n", "row 3, displacement_mm = 1e10: allowed is 0..2 mm"),
        ("t_s,force_N,rate_mm_s\n0,1,0\n1,1,-1e5\n", "row 3, rate_mm_s = -1e5: allowed is -300..300 mm/s"),
        ("t_s,force_N\n0,1\n0,2\n", "row 3, t_s = 0: allowed is above"),
        ("t_s,force_N\n1,1\n0,2\n", "row 3, t_s = 0: allowed is above"),
        ("t_s,force_N\n0,1\n1\n", "row 3 has 1 values: allowed is 2"),
        ("t_s,force_N\n0,1\n1,1,5\n", "row 3 has 3 values"),
        ("t_s,force_N\n0,1\n1,1_5\n", "row 3, force_N = '1_5'"),
        ("t_s,force_N\n0,1\n1,\n", "row 3, force_N = ''"),
        ('t_s,force_N\n0,"1\n', "not CSV"),
        ("t_s;force_N\n0;1\n", "no column t_s"),
        ("t_s,force_N\n0," + "9" * 200_000 + "\n", "not CSV"),
        (b"t_s,force_N\n0,\xff\n", "not UTF-8"),
        (b"\x00\x01\x02", "task.csv"),
    ],
)
def test_a_faulty_file_is_refused_by_row_column_and_value(tmp_path, ctl, content, named):
    file = tmp_path / "task.csv"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert named in ctl("--json", "send", str(file)).ended(2).error["message"]


@given(st.binary(max_size=300))
def test_any_bytes_are_a_waveform_or_refused(tmp_path_factory, data):
    file = Path(tmp_path_factory.getbasetemp()) / "any.csv"
    file.write_bytes(b"t_s,force_N\n" + data)
    try:
        waveform = read_csv(file)
    except ForceFileError:
        return
    assert 0.0 <= waveform.at(waveform.duration_s / 2).force_N <= 1_000.0


def test_byte_order_mark_windows_lines_and_blank_lines_are_read(tmp_path):
    file = tmp_path / "task.csv"
    file.write_bytes("\ufefft_s,force_N\r\n0,1\r\n\r\n2,3\r\n".encode())
    waveform = read_csv(file)
    assert (waveform.duration_s, waveform.at(1.0).force_N, waveform.at(1.0).displacement_mm) == (2.0, 2.0, None)


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


def test_shapes_have_their_frequency_and_their_step():
    step = shape("step", 1.0, 2.0, 1.0, 4.0)
    assert (step.at(1.999).force_N, step.at(2.0).force_N) == (1.0, 2.0)
    sine = shape("sine", 1.0, 2.0, 2.0, 4.0)
    assert (sine.at(0.25).force_N, sine.at(0.5).force_N) == pytest.approx((2.0, 1.0))
    pulse = shape("pulse", 1.0, 2.0, 0.5, 4.0)
    assert pulse.at(0.5).force_N == pytest.approx(pulse.at(2.5).force_N)
