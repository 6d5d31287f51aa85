"""The firmware's C sources, built for this machine; tests that need them skip where there is no C compiler."""

import ctypes
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from firmware_protocol.c.build import BuildError, Target, build, compiler, load_library

Exchange = Callable[[list[str]], list[str]]


@pytest.fixture(scope="session")
def c_compiler() -> str:
    try:
        return compiler()
    except BuildError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def library(c_compiler: str) -> ctypes.CDLL:
    """The sources as a shared library. What does not compile fails the test; only a missing compiler skips it."""
    return load_library()


@pytest.fixture(scope="session")
def exchange(c_compiler: str, tmp_path_factory: pytest.TempPathFactory) -> Exchange:
    """Puts requests, one a line, to the sources under the sanitizers (see host/exchange.c), and gives the answers."""
    probe = tmp_path_factory.mktemp("probe") / "probe.c"
    probe.write_text("int main(void) { return 0; }\n", encoding="ascii")
    command = [c_compiler, "-fsanitize=address,undefined", str(probe), "-o", str(probe.with_suffix(""))]
    if subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip(f"{c_compiler} has no address and undefined-behaviour sanitizers")
    program: Path = build(Target.SANITIZED_EXCHANGE)

    def ask(requests: list[str]) -> list[str]:
        result = subprocess.run(
            [program],
            input="".join(f"{request}\n" for request in requests),
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert result.returncode == 0, result.stderr
        answers = result.stdout.splitlines()
        assert len(answers) == len(requests)
        return answers

    return ask
