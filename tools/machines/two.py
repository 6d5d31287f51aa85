"""Two machines on one: network namespaces with a cable between them, at addresses made for documentation (RFC 5737)."""

import contextlib
import itertools
import os
import subprocess
from collections.abc import Iterator
from typing import NamedTuple

HERE, THERE = "192.0.2.1", "192.0.2.2"
_numbers = itertools.count(1)


class NotPermittedError(Exception):
    """This machine allows no network namespaces, or no cable between them; the text says which, and why."""


class Machines(NamedTuple):
    """What a command begins with to run on either: at HERE, and at THERE."""

    here: tuple[str, ...]
    there: tuple[str, ...]


@contextlib.contextmanager
def two_machines() -> Iterator[Machines]:
    """Makes them; what runs there has to have ended before they are taken away. Raises NotPermittedError."""
    number = f"{os.getpid() % 10_000}{next(_numbers)}"
    here, there = (f"tormag{number}{end}" for end in "ab")
    with contextlib.ExitStack() as stack:
        for line in (
            f"netns add {here}",
            f"netns add {there}",
            f"link add t{number}a netns {here} type veth peer name t{number}b netns {there}",
            f"-n {here} addr add {HERE}/30 dev t{number}a",
            f"-n {there} addr add {THERE}/30 dev t{number}b",
            f"-n {here} link set t{number}a up",
            f"-n {there} link set t{number}b up",
        ):
            try:
                subprocess.run(["ip", *line.split()], check=True, capture_output=True, text=True)
            except (OSError, subprocess.CalledProcessError) as error:
                reason = getattr(error, "stderr", "") or str(error)
                raise NotPermittedError(f"no network namespaces here: ip {line}: {reason.strip()}") from error
            if line.startswith("netns"):
                name = line.split()[-1]
                stack.callback(subprocess.run, ["ip", "netns", "del", name], check=False, capture_output=True)
        yield Machines(*(("ip", "netns", "exec", name) for name in (here, there)))
