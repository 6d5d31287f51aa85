import re
import shlex

import new_user
import pytest
from first_use.mistakes import ALONE, BESIDE, Mistake, judged, put
from first_use.terminal import Terminal

from tormagd.config import Config, checked
from tormagd.ctl import main as ctl
from tormagd.daemon import main as daemon
from tormagd.toml_file import toml_tables

COMMANDS = {"tormagctl": ctl.main, "tormagd": daemon.main}


@pytest.mark.parametrize("mistake", ALONE, ids=lambda mistake: mistake.name.replace(" ", "_"))
def test_a_mistake_that_needs_no_daemon_is_answered_in_a_sentence(mistake, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    put(mistake.files, tmp_path)
    name, *arguments = shlex.split(mistake.command)
    try:
        code = COMMANDS[name](arguments)
    except SystemExit as ended:
        code = int(str(ended.code))
    assert judged(mistake, code, "".join(capsys.readouterr())).wrong == ""


def test_the_twenty_mistakes_are_twenty():
    assert len({mistake.name for mistake in ALONE + BESIDE}) == 20


@pytest.mark.parametrize(
    ("code", "printed", "wrong"),
    [
        (2, "no such thing\n  next: give another", ""),
        (2, "usage: tormagctl [-h]\n    COMMAND ...\ntormagctl: error: no such thing", ""),
        (1, "no such thing", "exit code 1, 2 is documented"),
        (2, "something", "it does not say 'no such thing'"),
        (2, "Traceback (most recent call last):\n  no such thing", "it is more than a sentence"),
        (2, "this\nthat\nno such thing", "it is more than a sentence"),
    ],
)
def test_an_answer_is_judged_by_code_words_and_length(code, printed, wrong):
    assert judged(Mistake("m", "c", 2, "no such thing"), code, printed).wrong == wrong


def test_the_readme_has_a_configuration_and_lines_for_three_terminals(tmp_path):
    lines = new_user.readme().lines
    assert {number for number, _, _ in lines} == {"1", "2", "3"}
    assert [line.split()[0] for _, line, comment in lines if new_user.LASTING in comment] == [
        *("python", "tormagd", "tormagctl")
    ]
    config = checked(toml_tables(new_user.configured('port = "/dev/pts/9"', tmp_path)), Config)
    assert (config.device.port, config.endpoints.control) == ("/dev/pts/9", f"ipc://{tmp_path}/sockets/control")


def test_a_terminal_tells_code_and_words_and_ctrl_c_ends_what_goes_on(tmp_path):
    with Terminal(tmp_path, {"PATH": "/usr/bin:/bin"}) as terminal:
        assert terminal.run("echo one; false") == (1, "one\n")
        said = terminal.start("(trap 'echo bye; exit 0' INT; echo ready; sleep 60)", re.compile("^rea.*$"))
        assert said == "ready"
        code, said = terminal.end()
        assert (code, said.split()) == (0, ["bye"])
        assert terminal.run("true")[0] == 0
