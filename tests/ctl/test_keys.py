import stat
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from served import NAMES, Served, free_ports

from tormagd.config import Config
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
    assert {str(path.relative_to(keys)) for path in keys.rglob("*")} == {
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


Shows = Callable[..., tuple[str, ...]]


@pytest.fixture
def shows(keys: Path, tmp_path: Path) -> Shows:

    def made(address: str, **files: str) -> tuple[str, ...]:
        named = "".join(f'{name} = "{keys / file}"\n' for name, file in files.items())
        config = tmp_path / "client.toml"
        config.write_text(f'[endpoints]\ncontrol = "{address}"\n{named and f"[endpoints.curve]{chr(10)}{named}"}')
        return "--json", "--config", str(config)

    return made


def test_a_listed_key_is_answered(shows: Shows, guarded: str, ctl) -> None:
    mine = shows(guarded, client_secret="console.key_secret", server_public="server.key")
    assert ctl(*mine, "--wait", "20", "mark", "here").ended(0).result == {"operating_state": "DISABLED"}


@pytest.mark.parametrize("files", [{}, {"client_secret": "robot.key_secret", "server_public": "server.key"}], ids=str)
def test_another_key_or_none_is_not_answered_and_the_hint_says_where_to_look(
    shows: Shows, guarded: str, ctl, files: dict[str, str]
) -> None:
    error = ctl(*shows(guarded, **files), "--wait", "0.3", "mark", "here").ended(3).error
    assert (error["code"], "client_secret and server_public" in error["hint"]) == ("unreachable", True)


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
    ("files", "named"),
    [
        (("console.key_secret",), "the daemon's public key is not given"),
        (("/nowhere/a.key_secret", "server.key"), "/nowhere/a.key_secret: No such file"),
        (("/dev/zero", "server.key"), "/dev/zero: allowed is a regular file"),
        (("operate/console.key", "server.key"), "holds no secret key"),
        (("console.key_secret", "/dev/zero"), "/dev/zero: allowed is a regular file"),
    ],
)
def test_a_key_that_is_no_good_is_a_usage_error(shows: Shows, ctl, files: tuple[str, ...], named: str) -> None:
    named_so = dict(zip(("client_secret", "server_public"), files, strict=False))
    assert named in ctl(*shows("tcp://192.0.2.1:5555", **named_so), "status").ended(2).error["message"]
