import subprocess

import pytest
from house import findings

LONG = "def long():\n" + "".join(f"    a{at} = {at}\n" for at in range(50))
WORDY = f'def wordy():\n    """{"word " * 100}"""\n'
BRANCHED = f"def branched(a):\n    return {' or '.join(f'a == {at}' for at in range(11))}\n"
ALLOWED = {"statements": 1_000, "words": 1_000, "long": 0, "complex": 0}


@pytest.mark.parametrize(
    ("added", "allowed", "found"),
    [
        ("a = 1  # of a room\n", {}, []),
        (LONG, {}, ["room: 1 long, 0 are allowed"]),
        (WORDY, {}, ["room/a.py: the docstring of `wordy` has over 60 words"]),
        (BRANCHED, {}, ["room: 1 complex, 0 are allowed"]),
        ("a = 1\nb = 2\n", {"statements": 1}, ["room: 2 statements, 1 are allowed"]),
        ('"""Two words."""\n# and three more\n', {"words": 4}, ["room: 5 words, 4 are allowed"]),
        ("# simply put\n", {}, ["room/a.py: 'simply' is forbidden by docs/glossary.md"]),
    ],
)
def test_what_is_over_its_size_is_named(tmp_path, added, allowed, found):
    for name, text in (
        ("room/a.py", added),
        ("docs/glossary.md", "# Words\n\n## Not here\n\n| `simply` | nothing |\n"),
    ):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text(text)
    subprocess.run(["git", "init", "-q", "."], cwd=tmp_path, check=True)
    subprocess.run(["git", "add", "."], cwd=tmp_path, check=True)
    assert list(findings(tmp_path, {"all": {}, "pages": {}, "room": ALLOWED | allowed})) == found
