"""What the tests of tormagd share: a live test that the host spoiled is started again, twice at most.

If the host takes the processor for longer than the device may be silent, device and daemon protect themselves, and the
scenario is over. Only the kernel's counters and bare timers on every processor (`rigs/machines/host.py`) may blame the
host; otherwise it is a failure.
"""

import asyncio
import contextlib
import ctypes
import inspect
import os
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
from machines.host import HostWatch

from firmware_protocol.c.build import BuildError, compiler, load_library
from tormagd.config import Config
from tormagd.control.assembly.build import Core, build_core
from tormagd.ground.scheduling import ask_for_slices

ATTEMPTS = 3
WATCHED_ABOVE = 51
WATCHED = pytest.StashKey[HostWatch]()


@pytest.fixture(scope="session")
def core() -> Core:
    return build_core(Config())


@pytest.fixture(scope="session")
def c_compiler() -> str:
    try:
        return compiler()
    except BuildError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def library(c_compiler: str) -> ctypes.CDLL:
    return load_library()


@pytest.fixture
def usual_slices() -> Iterator[None]:
    yield
    ask_for_slices(0)


class HostWarning(UserWarning):
    """The host took so much that a live test was started again."""


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a coroutine test, and a live test again after a failure that the host explains."""
    call = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}
    if inspect.iscoroutinefunction(pyfuncitem.obj):
        asyncio.run(pyfuncitem.obj(**call))
        return True
    if pyfuncitem.get_closest_marker("live") is None:
        return None
    for attempt in range(1, ATTEMPTS + 1):
        watched = host_watch(pyfuncitem.config)
        start_s = time.monotonic()
        try:
            pyfuncitem.obj(**call)
            return True
        except (Exception, pytest.fail.Exception) as error:
            del pyfuncitem.config.stash[WATCHED]
            watched.end()
            host = watched.between(start_s, time.monotonic())
            if attempt == ATTEMPTS or not host.took_much:
                raise
            warnings.warn(f"{pyfuncitem.nodeid} is started again: {host}; {error}", HostWarning, stacklevel=2)
        folder = pyfuncitem._request.getfixturevalue("tmp_path_factory").mktemp("again")
        if "tmp_path" in call:
            call["tmp_path"] = folder
        for argument in call.values():
            if hasattr(argument, "start_again"):
                argument.start_again(folder)
    raise AssertionError("unreachable")


def host_watch(config: pytest.Config) -> HostWatch:
    """Return the session's bare timers, because starting them costs more than some tests do."""
    if WATCHED not in config.stash:
        with contextlib.ExitStack() as stack:
            nowhere = stack.enter_context(Path(os.devnull).open("w"))
            config.stash[WATCHED] = stack.enter_context(HostWatch(WATCHED_ABOVE, nowhere))
            config.add_cleanup(stack.pop_all().close)
    return config.stash[WATCHED]
