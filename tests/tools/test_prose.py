"""The check of the language finds what it is to find, and nothing in what is written well."""

from pathlib import Path

import pytest
from prose import ROOT, findings, forbidden_words

LONG = " ".join(["word"] * 31)
GLOSSARY = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
ROWS = f"brake   {LONG[:60]}\ngap     {LONG[:60]}\n"


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("a.md", f"Short. {LONG}.", ["1: 31 words"]),
        ("a.md", f"A paragraph.\n\n* {LONG}.", ["3: 31 words"]),
        ("a.md", f"`{LONG}`.\n\n```\n{LONG}\n```\n\n    {LONG}\n", []),
        (
            "a.md",
            "# A Set Point\n\n| a | b |\n| --- | --- |\n| e.g. | `set point` |\n",
            ["1: 'Set Point'", "5: 'e.g.'"],
        ),
        ("a.py", f'"""Short.\n\n{LONG}."""', ["3: 31 words"]),
        ("a.py", f'def f():\n    """Short.\n\n{ROWS}    """', []),
        ("a.py", f'A = 1\n"{LONG[:130]}: {LONG[:20]}."', ["2: 30 words"]),
        ("a.py", 'def f():\n    """Do."""\n    raise ValueError("x")', ["3: `f` raises ValueError"]),
        ("a.py", 'def f():\n    """Do. Raises ValueError where x is no number."""\n    raise ValueError("x")', []),
        (
            "a.py",
            'def f():\n    """Do."""\n    try:\n        raise a.B\n    except B:\n        raise C from b',
            ["6: `f` raises C"],
        ),
        ("a.py", 'class A:\n    """A."""\n    def __init__(self):\n        raise ValueError', ["4: `__init__` raises"]),
        ("a.py", 'def f():\n    """Do."""\n    def g():\n        raise ValueError\n    raise', []),
    ],
)
def test_what_breaks_a_rule_is_found_with_its_line(tmp_path: Path, name: str, text: str, found: list[str]) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    told = list(findings(tmp_path / name, forbidden_words(GLOSSARY)))
    assert [each[: len(begin)] for each, begin in zip(told, found, strict=True)] == found
