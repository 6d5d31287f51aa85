"""`tormagd_client`, blocking and for asyncio, at a daemon made of sockets."""

import asyncio
import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from decimal import Decimal
from functools import partialmethod
from itertools import repeat
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from tormagd_client import Client, ClientError, InFaultError, RefusedError, SettingError, UnreachableError
from tormagd_client.aio import AsyncClient
from tormagd_client.endpoints import ConfigError, Curve, Endpoints, in_folder
from tormagd_client.messages import Contact, Motion, Setpoint, decode
from tormagd_client.wire import Numbering

PATIENCE_S = 20.0


class Blocking:
    """Lets one set of tests serve both clients."""

    def __init__(self, folder: str, wait_s: float) -> None:
        async def made() -> AsyncClient:
            return AsyncClient.local(folder, wait_s, source="me")

        self._runner = asyncio.Runner()
        self._client = self._runner.run(made())

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return lambda *arguments, **named: self._runner.run(getattr(self._client, name)(*arguments, **named))

    def _first(self, topic: str, wait_s: float) -> list[Any]:
        return [self._runner.run(asyncio.wait_for(anext(getattr(self._client, topic)()), wait_s))]

    telemetry = partialmethod(_first, "telemetry")
    motions = partialmethod(_first, "motions")
    verdicts = partialmethod(_first, "verdicts")

    def close(self) -> None:
        self._client.close()
        self._runner.close()


@pytest.fixture(params=["blocking", "asyncio"])
def client(request, fake_daemon):
    folder = str(fake_daemon.directory)
    made = Client.local(folder, 5.0, source="me") if request.param == "blocking" else Blocking(folder, 5.0)
    yield made
    made.close()


def test_commands_and_status_are_answered(client, fake_daemon):
    assert client.request("take", source="robot") == {}
    assert fake_daemon.requests[-1]["args"] == {"source": "robot"}
    assert client.status().operating_state == "ENABLED"


@pytest.mark.parametrize(("code", "kind"), [("busy", RefusedError), ("fault", InFaultError)])
def test_a_refusal_names_command_reason_and_remedy(client, fake_daemon, code, kind):
    fake_daemon.refuse("enable", code)
    with pytest.raises(kind) as refused:
        client.request("enable")
    assert (refused.value.code, refused.value.message, refused.value.hint, str(refused.value)) == (
        code,
        "cannot enable",
        "do this first",
        "enable: cannot enable; do this first",
    )
    assert client.status().is_homed


def test_what_the_daemon_says_reaches_no_terminal_raw(client, fake_daemon):
    error = {"code": "busy", "message": "\x1b[2Jgone", "hint": "a\nb"}
    fake_daemon.answers["enable"] = lambda: {"ok": False, "error": error}
    with pytest.raises(RefusedError) as refused:
        client.request("enable")
    assert str(refused.value) == r"enable: \u001b[2Jgone; a\nb"
    fake_daemon.says(fault_details=[{"code": "X", "cause": "\x1b[2J", "remedy": ""}])
    assert client.status().fault_details[0].cause == r"\u001b[2J"


@pytest.mark.parametrize(
    "reply",
    [
        {"ok": True, "result": {}, "v": 2},
        {"ok": True},
        {"ok": False},
        {"ok": True, "result": {}, "id": None},
        {"ok": True, "result": {}, "error": {"code": "busy", "message": "", "hint": ""}},
        {"ok": "perhaps"},
        {"ok": True, "result": None},
        {"ok": True, "result": [1]},
        {"ok": False, "error": {"code": "a"}},
        {"ok": True, "result": {"operating_state": "PAUSED" * 1_000}},
    ],
)
def test_an_answer_that_says_neither_is_none(client, fake_daemon, reply):
    fake_daemon.answers["enable"] = lambda: reply
    with pytest.raises(UnreachableError, match="not one of tormagd's") as refused:
        client.request("enable")
    assert refused.value.code == "unintelligible"


def test_what_the_daemon_runs_is_typed_and_what_is_none_is_told(client, fake_daemon):
    assert client.describe().scene["name"] == "pulse"
    fake_daemon.answers["describe"] = lambda: {"ok": True, "result": {"version": "9"}}
    with pytest.raises(UnreachableError, match="the description of tormagd 9 is not what"):
        client.describe()


def test_late_answers_do_not_hold_a_call_nor_are_they_taken_for_its_own(fake_daemon):
    with Client.local(str(fake_daemon.directory), 5.0) as client:
        given_up = client.ask("status")
        assert client.answer(client.ask("take", source="robot"), PATIENCE_S) == {}
        assert client.answer(given_up) is None


SKEWED = {"code": "skewed", "cause": "they are apart", "remedy": "home"}
UNDER_WAY = {"given": ["home"], "is_over": False, "error": None}


def test_arming_tells_each_command_and_ends_when_the_daemon_has(client, fake_daemon):
    done = {"given": ["home", "enable"], "is_over": True, "error": None}
    fake_daemon.says_in_turn(*({"arm": report} for report in (UNDER_WAY, UNDER_WAY, done)))
    told: list[str] = []
    assert client.arm(told=told.append) == ("home", "enable")
    assert (told, fake_daemon.commands) == (["home", "enable"], ["arm", *["status"] * 3])


@pytest.mark.parametrize(
    ("report", "kind", "words"),
    [
        (UNDER_WAY | {"is_over": True, "error": SKEWED}, RefusedError, "they are apart"),
        (UNDER_WAY | {"is_over": True, "error": SKEWED | {"code": "fault"}}, InFaultError, "they are apart"),
        (None, RefusedError, "started anew"),
    ],
)
def test_an_arming_that_the_daemon_ended_says_why(client, fake_daemon, report, kind, words):
    fake_daemon.says(arm=report)
    with pytest.raises(kind, match=words):
        client.arm()
    assert fake_daemon.commands == ["arm", "status"]


def test_who_stops_waiting_for_an_arming_takes_the_word_back(client, fake_daemon):
    fake_daemon.says(arm=UNDER_WAY)
    with pytest.raises(RefusedError, match=r"not armed within 0\.1 s"):
        client.arm(0.1)
    assert fake_daemon.commands[-1] == "disable"
    with pytest.raises(KeyboardInterrupt):
        client.arm(told=Mock(side_effect=KeyboardInterrupt))
    assert fake_daemon.commands[-1] == "disable"


def test_an_arming_that_was_not_heard_to_begin_is_taken_back(client, fake_daemon):
    fake_daemon.answers["arm"] = lambda: {"ok": "perhaps"}
    with pytest.raises(UnreachableError):
        client.arm()
    assert fake_daemon.commands == ["arm", "disable"]


def test_setpoints_are_numbered_stamped_and_checked(client, fake_daemon):
    before_ns = time.time_ns()
    client.publish(1.5)
    client.publish(1.6, valid_for_ms=500.0, stamp_ns=7, rate_mm_s=5.0)
    with pytest.raises(ValueError, match=r"servo_cf = -1\.0: allowed is"):
        client.publish(-1.0)
    client.publish(1.7)
    first, second, third = fake_daemon.arrived(3)
    assert [(it.source, it.seq, it.servo_cf) for it in fake_daemon.setpoints] == [
        ("me", 0, 1.5),
        ("me", 1, 1.6),
        ("me", 2, 1.7),
    ]
    assert first.session == second.session == third.session < Numbering("me").session
    assert (first.valid_for_ms, second.valid_for_ms, second.stamp_ns, second.rate_mm_s) == (100.0, 500.0, 7, 5.0)
    assert before_ns <= first.stamp_ns <= time.time_ns()


@pytest.mark.parametrize("kind", [Client.local, Blocking])
def test_a_daemon_that_has_gone_takes_no_setpoints(run_dir, fake_daemon, kind):
    client = kind(str(run_dir), 1.0)
    client.publish(1.5)
    fake_daemon.is_over.set()
    fake_daemon.join(PATIENCE_S)
    with pytest.raises(UnreachableError, match="nobody takes setpoints"):
        deque(client.publish(1.5) for _ in repeat(None))  # the system reports the end in its own time
    client.close()


def test_a_law_of_the_handles_way_is_published_as_a_contact_or_what_has_its_names(client, fake_daemon):
    wall = Contact(handle_mm=12.0, stiffness_N_mm=0.5)
    client.publish(0.4, withdraw_cf=0.1, contact=wall)
    client.publish(0.4, contact={"handle_mm": 12.0, "stiffness_N_mm": 0.5, "friction_N": 0.1})
    with pytest.raises(ValueError, match=r"contact\.stiffness_N_mm = -1\.0: allowed is 0\.\.100"):
        client.publish(0.4, contact={"handle_mm": 12.0, "stiffness_N_mm": -1.0})
    with pytest.raises(ValueError, match=r"contact = \{'place': 12\.0\}: allowed are handle_mm"):
        client.publish(0.4, contact={"place": 12.0})
    first, second = fake_daemon.arrived(2)
    assert (first.withdraw_cf, first.contact, second.withdraw_cf) == (0.1, wall, None)
    assert second.contact == Contact(handle_mm=12.0, stiffness_N_mm=0.5, friction_N=0.1)


def test_telemetry_is_typed_and_each_topic_has_its_own(client):
    newest = client.telemetry(PATIENCE_S)
    assert (newest[0].operating_state, newest[0].measured_jp) == ("ENABLED", (35.0, 35.0))
    assert client.motions(PATIENCE_S)[0] == Motion(v=1, t_ns=7, device_s=0.5, handle_mm=3.0, handle_mm_s=-20.0)
    (verdict, *_) = client.verdicts(PATIENCE_S)
    assert (verdict.source, verdict.seq, verdict.outcome, verdict.arrives_ms) == ("me", 3, "cannot", None)
    assert all(client.telemetry(PATIENCE_S)[0].seq >= newest[0].seq for _ in range(3))


@pytest.mark.parametrize("call", [lambda it: it.request("status"), lambda it: it.publish(1.0)])
@pytest.mark.parametrize("kind", [lambda folder: Client.local(folder, 0.05), lambda folder: Blocking(folder, 0.05)])
def test_nobody_there_is_told_with_what_to_do(run_dir, kind, call):
    client = kind(str(run_dir))
    for _ in ("at first", "and again"):
        with pytest.raises(UnreachableError, match="there is no socket"):
            call(client)
    client.close()


def test_settings_that_cannot_be_used_are_named(tmp_path):
    with pytest.raises(ConfigError, match=r"endpoints\.setpoint.*at most 107 bytes"):
        in_folder("/" + "a" * 110)
    with pytest.raises(SettingError, match=r"robot\.key_secret"):
        Client(Endpoints(curve=Curve(client_secret=str(tmp_path / "robot.key_secret"), server_public="server.key")))
    assert issubclass(SettingError, ClientError)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"force_N": Decimal(1)}, "servo_cf is str"),
        ({"force_N": True}, "servo_cf is bool"),
        ({"force_N": None}, "servo_cf is missing"),
        ({"force_N": "1"}, "servo_cf is str"),
        ({"force_N": 2**70}, "message: allowed are"),
        ({"force_N": 1j}, "1j is none of them"),
        ({"valid_for_ms": True}, "valid_for_ms is bool"),
        ({"stamp_ns": 1e18}, "stamp_ns is float"),
        ({"preview_N": {}, "preview_dt_ms": 10.0}, "preview_N is map"),
    ],
)
def test_what_the_daemon_would_refuse_is_not_sent(changed: dict[str, Any], words: str) -> None:
    numbering = Numbering("me")
    with pytest.raises(ValueError, match=words):
        numbering.setpoint(**{"force_N": 1.0, "valid_for_ms": 100.0} | changed)
    assert numbering.sent == 0


def test_numbers_and_arrays_of_numpy_are_sent() -> None:
    data = Numbering("me").setpoint(np.float32(1.0), np.int64(50), preview_N=np.ones(2), preview_dt_ms=np.float64(10.0))
    sent = decode(data, Setpoint)
    assert (sent.servo_cf, sent.valid_for_ms, sent.preview_N, sent.preview_dt_ms) == (1.0, 50.0, (1.0, 1.0), 10.0)


def test_threads_do_not_take_each_others_answers(fake_daemon) -> None:
    with Client.local(str(fake_daemon.directory), PATIENCE_S) as client, ThreadPoolExecutor(4) as threads:
        assert all(status.is_homed for status in threads.map(lambda _: client.status(), range(40)))


def test_tasks_publish_at_once_and_each_of_them_hears_all_that_is_new(fake_daemon) -> None:
    async def run() -> None:
        async with AsyncClient.local(str(fake_daemon.directory), PATIENCE_S) as client, asyncio.timeout(PATIENCE_S):
            await asyncio.gather(*(client.publish(force_N) for force_N in (0.5, 1.0, 1.5)))
            before, others = await anext(client.telemetry()), client.telemetry()
            await asyncio.sleep(0.3)
            first = await anext(heard := client.telemetry())
            assert first.seq > before.seq + 10  # about 100 were sent
            pairs = [await asyncio.gather(anext(others), anext(heard)) for _ in range(10)]
            assert [each.seq for _, each in pairs] == [*range(first.seq + 1, first.seq + 11)]

    asyncio.run(run())
    assert len(fake_daemon.arrived(3)) == 3


def test_a_client_that_was_closed_or_made_before_a_fork_says_so(fake_daemon, monkeypatch) -> None:
    client = Client.local(str(fake_daemon.directory), PATIENCE_S)
    client.status()
    with monkeypatch.context() as forked:
        forked.setattr("os.getpid", lambda: 0)
        with pytest.raises(ClientError, match="another process"):
            client.status()
    client.close()
    with pytest.raises(ClientError, match="closed"):
        client.status()


@pytest.mark.parametrize("kind", [Client, AsyncClient])
@pytest.mark.parametrize("wait_s", [math.inf, math.nan, -1.0])
def test_a_time_to_wait_is_a_number_of_seconds(run_dir, kind, wait_s: float) -> None:
    with pytest.raises(ValueError, match="wait_s"):
        kind.local(str(run_dir), wait_s)
