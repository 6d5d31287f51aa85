"""The firmware's C sources under sanitizers; tests that need them skip where the C compiler has none."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from firmware_protocol.c.build import Target, build

Exchange = Callable[[list[str]], list[str]]


@pytest.fixture(scope="session")
def exchange(c_compiler: str, tmp_path_factory: pytest.TempPathFactory) -> Exchange:
    """Give requests, one a line, to the sources under the sanitizers (host/exchange.c), and return the answers."""
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
