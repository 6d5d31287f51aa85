"""`tormagctl send` is done when its setpoints were rendered, and says why when they were not."""

from itertools import chain, repeat
from typing import Any

import msgspec
import pytest

from tormagd.ctl.main import main
from tormagd.ctl.outcome import CommandError
from tormagd.ctl.watch import held_back
from tormagd_client.messages import Status

EXPLAINED = {
    "STALE": "setpoints of 'me' come 300 ms late",
    "OTHER_SOURCE": "'me' sends setpoints too, and 'robot' holds the brake",
    "F_MAX": "more force was asked for than the closed gap gives",
}


@pytest.fixture
def seen(status_with: Any, source_with: Any) -> Any:
    """Makes a status as the watch sees it, with what it says of the source `me`."""

    def made(source: dict[str, Any] | None = None, **changes: Any) -> Status:
        by_source = {} if source is None else {"me": source_with(**source)}
        setpoints = status_with()["setpoints"] | {"by_source": by_source, "newest_source": "robot"}
        details = [{"code": code, "cause": cause, "remedy": "do this"} for code, cause in EXPLAINED.items()]
        known = {"setpoints": setpoints, "limit_details": details}
        return msgspec.convert(status_with(**known | changes), Status)

    return made


def test_setpoints_that_are_taken_while_enabled_are_rendered(seen):
    assert held_back(seen({"state": "holds"}), "me") is None
    assert held_back(seen({"state": "holds"}, limits=["F_MIN", "RATE", "TAKEOVER"]), "me") is None


@pytest.mark.parametrize(
    ("source", "changes", "code", "exit_code", "said", "hint"),
    [
        ({}, {"operating_state": "DISABLED"}, "disabled", 1, "the device is DISABLED", "tormagctl enable"),
        ({}, {"operating_state": "DISABLED", "is_homed": False}, "disabled", 1, "DISABLED", "tormagctl home, then"),
        ({}, {"operating_state": "PAUSED"}, "paused", 1, "PAUSED", "tormagctl resume"),
        ({}, {"operating_state": "FAULT", "faults": ["SKEW"]}, "fault", 4, "in FAULT: SKEW", "clear-fault"),
        (None, {}, "not_heard", 1, "nothing of 'me': too much", "status"),
        ({"state": "refused"}, {}, "other_source", 1, "'robot' holds the brake", "do this"),
        ({"state": "refused"}, {"limit_details": []}, "other_source", 1, "'robot' holds", "tormagctl take me"),
        ({"state": "stale"}, {}, "stale", 1, "300 ms late", "do this"),
        ({"state": "stale"}, {"limit_details": []}, "stale", 1, "come too late", "status"),
        ({}, {"limits": ["F_MAX"]}, "f_max", 1, "more force was asked", "do this"),
        ({}, {"limits": ["RANGE"]}, "range", 1, "the limit RANGE", "status"),
    ],
)
def test_what_holds_a_force_back_is_named_with_its_remedy(seen, source, changes, code, exit_code, said, hint):
    with pytest.raises(CommandError) as held:
        raise held_back(seen(source, **changes), "me") or AssertionError("rendered")
    assert (held.value.code, held.value.exit_code) == (code, exit_code)
    assert said in held.value.message
    assert hint in held.value.hint


def test_when_sending_is_over_the_newest_may_be_stale(seen):
    assert held_back(seen({"state": "stale"}, limits=["RANGE"]), "me", is_over=True) is None
    assert held_back(seen({"state": "refused"}), "me", is_over=True).code == "other_source"


@pytest.fixture
def sent(fake_daemon: Any, ctl: Any) -> Any:
    """Sends a step of 0.4 s."""
    step = ("send", "step", "--duration", "0.4", "--rate", "50")
    return lambda: ctl(*fake_daemon.at, "--json", *step)


def test_what_was_rendered_is_told(fake_daemon, sent):
    fake_daemon.says(limits=["RATE"])
    done = sent().ended(0)
    result = done.result
    assert (done.err, result["accepted"], result["rendered_share"], result["limits"]) == (
        "",
        result["sent"],
        1.0,
        ["RATE"],
    )


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
    assert (done.result, done.error["code"]) == (None, code)
    assert says in done.error["message"]
    assert says[-10:] in done.err
    # in FAULT nothing is sent at all
    assert bool(fake_daemon.setpoints) == (expected == 1)


def test_setpoints_may_wait_for_enable_but_not_for_what_comes_after(fake_daemon, sent, status_with):
    """`enable` wants a neutral setpoint, so that a publisher is there before."""

    def states(*names: str) -> Any:
        each = chain(names, repeat(names[-1]))
        return lambda: {
            "ok": True,
            "result": status_with(operating_state=next(each), setpoints=fake_daemon.taken()),
        }

    fake_daemon.answers["status"] = states("DISABLED", "DISABLED", "ENABLED")
    done = sent().ended(0)
    assert 0.0 < done.result["rendered_share"] < 1.0
    assert done.err.count("not rendered: the device is DISABLED") == 1
    fake_daemon.setpoints.clear()
    fake_daemon.answers["status"] = states("ENABLED", "ENABLED", "PAUSED", "ENABLED")
    assert sent().ended(1).error["code"] == "paused"


def test_setpoints_that_nobody_took_are_no_success(fake_daemon, sent):
    fake_daemon.taken_by_source = False
    assert sent().ended(1).error["code"] == "not_heard"
    # taken in part: another publisher of the same name, or a loss
    fake_daemon.taken_by_source = True
    taken = fake_daemon.taken
    fake_daemon.taken = lambda: (
        taken()
        | {
            "by_source": {
                name: each | {"accepted": each["accepted"] // 2} for name, each in taken()["by_source"].items()
            }
        }
    )
    fake_daemon.setpoints.clear()
    assert sent().ended(1).error["code"] == "not_taken"


@pytest.mark.parametrize(
    "arguments", [("step", "--to-N", "5.5"), ("step", "--from-N", "0.4", "--to-N", "6"), ("FILE",)]
)
def test_what_the_scene_does_not_allow_is_not_sent(fake_daemon, ctl, tmp_path, arguments):
    file = tmp_path / "task.csv"
    file.write_text("t_s,force_N\n0,1\n1,7\n")
    told = [str(file) if each == "FILE" else each for each in arguments]
    error = ctl(*fake_daemon.at, "--json", "send", *told).ended(1).error
    assert error["code"] == "out_of_range"
    assert "allowed is 0..5 N in scene pulse; nothing was sent" in error["message"]
    assert fake_daemon.setpoints == []


def test_blind_it_asks_nothing_and_says_that_it_does_not_know(fake_daemon, capsys):
    fake_daemon.says(operating_state="DISABLED")
    assert main(["--endpoint", fake_daemon.control, "send", "step", "--duration", "0.05", "--blind"]) == 0
    assert "whether they were taken is not known" in capsys.readouterr().out
    assert fake_daemon.commands == []


def test_a_key_that_may_only_publish_is_told_how(run_dir, tmp_path, capsys):
    assert main(["keys", "generate", str(tmp_path / "keys"), "--publish", "robot"]) == 0
    keys = ("--key", str(tmp_path / "keys/robot.key_secret"), "--server-key", str(tmp_path / "keys/server.key"))
    assert main(["--endpoint", f"ipc://{run_dir}/control", *keys, "--wait", "0.05", "send", "step"]) == 3
    assert "with a key that may only publish: --blind" in capsys.readouterr().err


def test_a_daemon_that_takes_setpoints_and_does_not_answer_is_not_reached(fake_daemon, run_dir, tmp_path):
    config = tmp_path / "tormagd.toml"
    config.write_text(f'[endpoints]\ncontrol = "ipc://{run_dir}/nobody"\nsetpoint = "ipc://{run_dir}/setpoint"\n')
    assert (main(["--config", str(config), "--wait", "0.1", "send", "step"]), fake_daemon.setpoints) == (3, [])
