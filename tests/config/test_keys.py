"""Key files: what is made, and what is refused with a sentence."""

import os
import shutil
import stat
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from unittest.mock import Mock

import pytest
import zmq

from tormagd.config import Config
from tormagd.ground.access_keys import KeyRing, require_own
from tormagd_client.endpoints import ENDPOINTS, ConfigError, Curve, Endpoints
from tormagd_client.keys import MAX_KEY_FILE_BYTES, fingerprint, generate, load_pair, load_public

FAR = {name: f"tcp://192.0.2.1:{5_555 + number}" for number, name in enumerate(ENDPOINTS)}


def ring(folder: Path) -> KeyRing:
    return KeyRing(
        Config(endpoints=Endpoints(**FAR, curve=Curve(server_secret=str(folder / "server.key_secret")))).endpoints
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    generate("server", tmp_path, tmp_path)
    for role in ("publish", "operate", "observe"):
        generate(f"{role}r", tmp_path, tmp_path / role)
    return tmp_path


def test_keys_are_their_owners_only_and_a_pair(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        secret, public = generate("robot", tmp_path / "a", tmp_path / "a/publish")
    finally:
        os.umask(before)
    assert [stat.S_IMODE(path.stat().st_mode) for path in (secret, public, tmp_path / "a")] == [0o600, 0o600, 0o700]
    pair = load_pair(secret)
    assert zmq.curve_public(pair.secret) == pair.public == load_public(public) == load_public(secret)
    assert "secret-key" not in public.read_text()
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["publish", "robot.key_secret"]


def test_a_folder_of_somebody_else_is_refused() -> None:
    folder = Mock(stat=Mock(return_value=Mock(st_uid=os.geteuid() + 1, st_mode=0o40755)))
    with pytest.raises(ConfigError, match=r"belongs to user \d+: allowed are this process's own and root"):
        require_own(folder)


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    secret, public = generate("robot", tmp_path, tmp_path / "publish")
    kept = secret.read_bytes(), public.read_bytes()
    with pytest.raises(ConfigError, match=f"^{secret} exists: keys are never overwritten"):
        generate("robot", tmp_path, tmp_path / "publish")
    secret.unlink()
    with pytest.raises(ConfigError, match=f"^{public} exists"):
        generate("robot", tmp_path, tmp_path / "publish")
    assert not secret.exists()
    assert public.read_bytes() == kept[1]


@pytest.mark.parametrize("name", ["", ".", "..", "../robot", "a/b", "-robot", "a\x1b[2J", "x" * 65, "robot\n"])
def test_a_name_is_a_files_name(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError, match=r"^name = "):
        generate(name, tmp_path, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_lists_say_who_may_do_what(folder: Path) -> None:
    (folder / "observe/other.key").write_bytes((folder / "publish/publishr.key").read_bytes())
    (folder / "observe/other.key").chmod(0o644)
    (folder / "observe/README").write_text("not a key")
    keys = ring(folder)
    assert keys.server == load_pair(folder / "server.key_secret")
    (folder / "publish/broken.key").write_text("nothing")
    with pytest.raises(ConfigError, match=r"broken\.key holds no public key"):
        keys.load_allowed()
    # what was read before stays
    roles = sorted((listed.name, sorted(listed.roles)) for listed in keys.allowed.values())
    assert roles == [("observer", ["observe"]), ("operater", ["operate"]), ("other", ["observe", "publish"])]


@pytest.mark.parametrize(
    ("name", "mode", "said"),
    [
        *(("server.key_secret", mode, "can be read by others .*chmod 600") for mode in (0o640, 0o604, 0o660, 0o644)),
        *((name, 0o770, "can be written by others .*chmod go-w") for name in ("publish", "operate/operater.key")),
    ],
)
def test_a_secret_that_others_can_read_and_a_list_that_they_can_write_are_refused(
    folder: Path, name: str, mode: int, said: str
) -> None:
    path, said = folder / name, said.replace(" .*", rf" \(mode {mode:04o}\).*")
    path.chmod(mode)
    with pytest.raises(ConfigError, match=f"^{path} {said} {path}"):
        ring(folder)


def broken(content: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / "publish/broken.key").write_bytes(content)


NO_KEYS = {
    b"": "holds no public key",
    b"curve\n    public-key\n": "holds no public key",
    b'curve\n    public-key = "short"\n': "40 characters",
    b'curve\n    public-key = "%s"\n' % (40 * b"~"): "40 characters",
    b'curve\n    public-key = "%s"\n' % (40 * b"#"): "40 characters",
    b"x" * (MAX_KEY_FILE_BYTES + 1): "at most 4096 bytes",
    b"\xff" * 100: "holds no public key",
}


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda folder: os.mkfifo(folder / "publish/pipe.key", 0o600), "publish/pipe.key: allowed is a regular file"),
        (lambda folder: shutil.rmtree(folder / "observe"), "observe: No such file or directory: make it"),
        *((broken(content), f"publish/broken.key.*{named}") for content, named in NO_KEYS.items()),
    ],
)
def test_what_is_no_file_or_missing_is_named_and_not_waited_for(
    folder: Path, spoil: Callable[[Path], object], said: str
) -> None:
    spoil(folder)
    with pytest.raises(ConfigError, match=f"^{folder}/{said}"):
        ring(folder)


def test_keys_that_do_not_belong_together_are_refused(folder: Path) -> None:
    mine, other = (folder / f"{name}.key_secret" for name in ("server", "publishr"))
    mine.write_text(mine.read_text().replace(load_pair(mine).public.decode(), load_pair(other).public.decode()))
    with pytest.raises(ConfigError, match="do not belong together"):
        load_pair(mine)


def test_a_fingerprint_is_the_keys_own() -> None:
    # the key of ZeroMQ's own documentation (zmq_curve), as text and as bytes
    key = bytes.fromhex("BB88471D65E2659B30C55A5321CEBB5AAB2B70A398645C26DCA2B2FCB43FC518")
    assert fingerprint(b"Yne@$w-vo<fVvi]a<NY6T1ed:M$fCG*[IaLV{hID").replace(":", "") == sha256(key).hexdigest()[:16]


def test_other_machines_are_taken_with_keys_only() -> None:
    with pytest.raises(ValueError, match=r"endpoints.setpoint = 'tcp://192.0.2.1:5555': .* CURVE keys in \[endpoints"):
        Config(endpoints=Endpoints(**FAR))
    with pytest.raises(ValueError, match="CURVE"):
        Config(endpoints=Endpoints(**FAR, curve=Curve()))
    for curve in (Curve(server_secret="a"), Curve(client_secret="a")):
        assert all(Config(endpoints=Endpoints(**FAR, curve=curve)).endpoints.is_guarded(name) for name in ENDPOINTS)


@pytest.mark.parametrize("address", ["tcp://eth0:5555", "tcp://300.0.0.1:1", "tcp://[::1]:1", "tcp://192.0.2.1:0", "*"])
def test_with_keys_too_an_address_has_to_be_one(address: str) -> None:
    with pytest.raises(ValueError, match="IPv4 address and a port"):
        Config(endpoints=Endpoints(setpoint=address, curve=Curve(server_secret="a")))


def test_local_endpoints_are_open_unless_the_configuration_says_so() -> None:
    local = {"setpoint": "tcp://127.0.0.1:5555", "control": "ipc:///tmp/control"}
    for also_local in (False, True):
        endpoints = Config(
            endpoints=Endpoints(**local, curve=Curve(server_secret="a", also_local=also_local))
        ).endpoints
        assert [endpoints.is_guarded(name) for name in ENDPOINTS] == [also_local] * 4
    with pytest.raises(ValueError, match="also_local"):
        Config(endpoints=Endpoints(**local, curve=Curve(also_local=True)))
