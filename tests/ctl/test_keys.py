import stat
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from served import NAMES, Served, free_ports

from tormagd.config import Config
from tormagd.ctl.commands import KEY, SERVER_KEY
from tormagd.daemon.endpoint import Endpoint
from tormagd.ground.access_keys import KeyRing
from tormagd_client.aio import AsyncClient
from tormagd_client.blocking import Client
from tormagd_client.endpoints import Curve, Endpoints
from tormagd_client.errors import UnreachableError


@pytest.fixture
def keys(tmp_path: Path, ctl) -> Path:
    ctl("keys", "generate", str(tmp_path / "keys"), "--operate", "console", "--publish", "robot").ended(0)
    return tmp_path / "keys"


def test_one_command_makes_the_server_its_clients_and_the_lists(keys: Path) -> None:
    made = {str(path.relative_to(keys)) for path in keys.rglob("*")}
    assert made == {
        *("server.key", "server.key_secret", "console.key_secret", "robot.key_secret"),
        *("publish", "operate", "observe", "publish/robot.key", "operate/console.key"),
    }
    for path in keys.rglob("*"):
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600)


def test_a_client_is_added_later_and_nothing_is_made_twice(keys: Path, ctl) -> None:
    before = (keys / "server.key_secret").read_bytes()
    printed = ctl("--json", "keys", "generate", str(keys), "--observe", "screen").ended(0)
    assert [made["name"] for made in printed.result["made"]] == ["screen"]
    for arguments in ((), ("--observe", "screen"), ("--publish", "server")):
        assert "exists: keys are never overwritten" in ctl("keys", "generate", str(keys), *arguments).ended(2).err
    assert (keys / "server.key_secret").read_bytes() == before


def test_a_folder_of_keys_is_shown(keys: Path, ctl) -> None:
    (shown,) = ctl("--json", "keys", "show", str(keys / "publish/robot.key")).ended(0).result["keys"]
    assert ctl("keys", "show", str(keys / "publish")).ended(0).out == f"{shown['fingerprint']}  robot\n"


@pytest.fixture
def guarded(keys: Path) -> Iterator[str]:
    """An endpoint that believes listed keys."""
    address = f"tcp://127.0.0.1:{free_ports(1)[0]}"
    addresses = {name: f"ipc://{keys}/{name}" for name in NAMES} | {"control": address}
    curve = Curve(server_secret=str(keys / "server.key_secret"), also_local=True)
    endpoints = Config(endpoints=Endpoints(**addresses, curve=curve)).endpoints
    served, is_over = Served(addresses, Endpoint(endpoints, keys=KeyRing(endpoints))), threading.Event()
    serving = threading.Thread(target=served.until, args=(is_over.is_set,))
    serving.start()
    yield address
    is_over.set()
    serving.join()
    served.close()


def test_a_key_is_shown_by_option_by_environment_and_by_configuration(
    keys: Path, guarded: str, ctl, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    mine, server = str(keys / "console.key_secret"), str(keys / "server.key")
    patient = ("--wait", "20")
    shown = (*patient, "--endpoint", guarded, "--key", mine, "--server-key", server, "--json")
    assert ctl(*shown, "mark", "here").ended(0).result == {"operating_state": "DISABLED"}
    config = tmp_path / "client.toml"
    config.write_text(
        f'[endpoints]\ncontrol = "{guarded}"\n[endpoints.curve]\nclient_secret = "{mine}"\nserver_public = "{server}"\n'
    )
    ctl(*patient, "--config", str(config), "mark", "here").ended(0)
    monkeypatch.setenv(KEY, mine)
    monkeypatch.setenv(SERVER_KEY, server)
    ctl(*patient, "--endpoint", guarded, "mark", "here").ended(0)


def test_another_key_or_none_is_not_answered_and_the_hint_says_where_to_look(keys: Path, guarded: str, ctl) -> None:
    for arguments in ((), ("--key", str(keys / "robot.key_secret"), "--server-key", str(keys / "server.key"))):
        error = ctl("--endpoint", guarded, "--wait", "0.3", "--json", *arguments, "mark", "here").ended(3).error
        assert (error["code"], "--key and --server-key" in error["hint"]) == ("unreachable", True)


async def test_who_was_refused_and_asks_again_is_told_and_does_not_wait_for_ever(guarded: str) -> None:
    endpoints = Endpoints(control=guarded)
    with Client(endpoints, wait_s=0.2) as client:
        for _ in range(3):
            with pytest.raises(UnreachableError):
                client.request("disable")
    async with AsyncClient(endpoints, wait_s=0.2) as client:
        for _ in range(3):
            with pytest.raises(UnreachableError):
                await client.request("disable")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--key", "KEYS/console.key_secret"), "--server-key"),
        (("--key", "/nowhere/a.key_secret", "--server-key", "KEYS/server.key"), "/nowhere/a.key_secret: No such file"),
        (("--key", "/dev/zero", "--server-key", "KEYS/server.key"), "/dev/zero: allowed is a regular file"),
        (("--key", "KEYS/operate/console.key", "--server-key", "KEYS/server.key"), "holds no secret key"),
        (("--key", "KEYS/console.key_secret", "--server-key", "/dev/zero"), "/dev/zero: allowed is a regular file"),
    ],
    ids=range(5),
)
def test_a_key_that_is_no_good_is_a_usage_error(keys: Path, ctl, arguments: tuple[str, ...], named: str) -> None:
    placed = [each.replace("KEYS", str(keys)) for each in arguments]
    error = ctl("--endpoint", "tcp://192.0.2.1:5555", "--json", *placed, "status").ended(2).error
    assert named in error["message"] + error["hint"]
