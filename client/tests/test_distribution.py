"""The client is a distribution of its own: what it needs and what it brings."""

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = sorted((ROOT / "client/src/tormagd_client").glob("*.py"))
NEEDED = {"zmq", "msgpack", "msgspec"}

BLOCKED = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in {"tormagd_client", "zmq", "msgpack", "msgspec", *sys.stdlib_module_names}:
            raise ModuleNotFoundError(f"{name} is blocked")
sys.meta_path.insert(0, Blocked())
import tormagd_client, tormagd_client.aio, tormagd_client.keys, tormagd_client.messages
for name in tormagd_client.__all__:
    getattr(tormagd_client, name)
"""


def imported(source: Path) -> set[str]:
    nodes = list(ast.walk(ast.parse(source.read_text(encoding="utf-8"))))
    names = {each.name for node in nodes if isinstance(node, ast.Import) for each in node.names}
    names |= {str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)}
    return {name.partition(".")[0] for name in names}


@pytest.mark.parametrize("source", SOURCES, ids=lambda it: it.name)
def test_it_imports_its_libraries_and_nothing_of_the_daemon(source: Path) -> None:
    assert imported(source) <= NEEDED | {"tormagd_client"} | sys.stdlib_module_names


def test_it_runs_where_nothing_else_can_be_imported() -> None:
    ran = subprocess.run([sys.executable, "-P", "-c", BLOCKED], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")


def test_who_reads_messages_does_not_wait_for_sockets() -> None:
    script = "import sys, tormagd_client.messages; sys.exit('zmq' in sys.modules)"
    subprocess.run([sys.executable, "-P", "-c", script], check=True)


def test_it_needs_three_packages() -> None:
    project = tomllib.loads((ROOT / "client" / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert {each.partition(">")[0] for each in project["dependencies"]} == {"pyzmq", "msgpack", "msgspec"}


def test_a_machine_with_the_client_alone_makes_its_keys(tmp_path: Path) -> None:
    command = [sys.executable, "-P", "-m", "tormagd_client.keys"]
    made = subprocess.run([*command, "robot", str(tmp_path)], capture_output=True, text=True, check=True)
    assert made.stdout.startswith(f"{tmp_path}/robot.key_secret stays here; {tmp_path}/robot.key goes to the daemon: ")
    again = subprocess.run([*command, "robot", str(tmp_path)], capture_output=True, text=True, check=False)
    assert again.returncode == 1
    assert "keys are never overwritten" in again.stderr
    wrong = subprocess.run(command, capture_output=True, text=True, check=False)
    assert wrong.stderr == "usage: python -m tormagd_client.keys NAME FOLDER\n"
