"""A daemon's keys for a measurement: its own, a client's that may do everything, and two of a single role each."""

import shutil
import socket
from pathlib import Path

from tormagd_client.keys import PUBLIC, SECRET, SERVER, generate

CLIENT = "client"
"Publishes and operates."
PUBLISHER, OBSERVER = "robot", "screen"
"Each listed for one role only."


def curve_table(folder: Path, *, also_local: bool) -> str:
    """Makes the keys in `folder`; the table `[endpoints.curve]` that daemon and client can both read."""
    generate(SERVER, folder, folder)
    for name, role in ((CLIENT, "publish"), (PUBLISHER, "publish"), (OBSERVER, "observe")):
        generate(name, folder, folder / role)
    (folder / "operate").mkdir(mode=0o700)
    shutil.copy2(folder / "publish" / f"{CLIENT}{PUBLIC}", folder / "operate")
    return (
        f'[endpoints.curve]\nserver_secret = "{folder}/{SERVER}{SECRET}"\nclient_secret = "{folder}/{CLIENT}{SECRET}"\n'
        f"also_local = {str(also_local).lower()}\n"
    )


def free_port() -> int:
    """A TCP port that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("", 0))
        port: int = probe.getsockname()[1]
        return port
