"""sd_notify(3): telling systemd READY=1, WATCHDOG=1, STATUS=... or STOPPING=1."""

import os
import socket


def notify(message: str) -> bool:
    """Send `message`, lines of `NAME=value`, to the service manager; False where there is none, or it does not listen.

    A NOTIFY_SOCKET that begins with `@` is an abstract socket. Never blocks.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return False
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as sender:
        try:
            sender.sendto(message.encode(), "\0" + address[1:] if address.startswith("@") else address)
        except OSError:
            return False
    return True
