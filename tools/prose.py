"""Checks the language of docstrings and pages: `python tools/prose.py` lists what breaks a rule, and ends with 1.

A sentence has at most MAX_WORDS words. A docstring names every error that its function raises, in a sentence; ruff and
pydoclint would want a section. Words that the last table of docs/glossary.md forbids are not used.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).parents[1]
MAX_WORDS = {".py": 25, ".md": 30}
UNREAD = ("tests/",)
UNSAID = {"NotImplementedError", "AssertionError", "Unmet"}
"Errors that no docstring names: of mistakes in the code, and that by which a check of the conformance kit says no."
MARKDOWN = MarkdownIt("commonmark").enable("table")
SENTENCE_END = re.compile(r"(?<=[.!?])[\"')*]*\s+")
ROW = re.compile(r"\n(?=.*?\S {2,}\S)")
WORD = re.compile(r"\S*\w\S*")
Function = ast.FunctionDef | ast.AsyncFunctionDef
Scope = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def main() -> str:
    """Return what breaks a rule in the files that git knows outside UNREAD, a line each."""
    listed = subprocess.check_output(["git", "ls-files", "*.py", "*.md"], cwd=ROOT, text=True)
    forbidden = forbidden_words((ROOT / "docs" / "glossary.md").read_text(encoding="utf-8"))
    read = (name for name in listed.split() if not name.startswith(UNREAD))
    return "\n".join(f"{name}:{each}" for name in read for each in findings(ROOT / name, forbidden))


def forbidden_words(glossary: str) -> re.Pattern[str]:
    """Return what matches the words that the last table of `glossary` has as code."""
    words = re.findall(r"`([^`]+)`", glossary.rpartition("\n## ")[2])
    return re.compile(rf"(?<!\w)(?:{'|'.join(map(re.escape, words))})(?!\w)", re.IGNORECASE)


def findings(file: Path, forbidden: re.Pattern[str]) -> Iterator[str]:
    """Yield `LINE: what breaks a rule` for a Python file or a page."""
    text = file.read_text(encoding="utf-8")
    tree = ast.parse(text if file.suffix == ".py" else "")
    for line, prose in docstrings(tree) if file.suffix == ".py" else [(1, text)]:
        for at, sentence in sentences(prose):
            if (count := len(WORD.findall(sentence))) > MAX_WORDS[file.suffix]:
                yield f"{line + at}: {count} words in a sentence: {sentence[:60]!r}"
            yield from (f"{line + at}: {word!r} is forbidden by the glossary" for word in forbidden.findall(sentence))
    for owner in (each for each in ast.walk(tree) if isinstance(each, Scope)):
        for function in (each for each in owner.body if isinstance(each, Function)):
            yield from unnamed_errors(function, owner)


def docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line of each docstring, also those of attributes, and its text without indentation, rows apart."""
    for each in ast.walk(tree):
        match each:
            case ast.Expr(ast.Constant(str(text))):
                yield each.lineno, ROW.sub("\n\n", re.sub(f"^ {{{each.col_offset}}}", "", text, flags=re.MULTILINE))


def sentences(markdown: str) -> Iterator[tuple[int, str]]:
    """Yield each sentence, and after how many lines its paragraph begins."""
    for block in MARKDOWN.parse(markdown):
        if block.type == "inline" and block.map:
            words = ("`code`" if each.type == "code_inline" else each.content or " " for each in block.children or ())
            yield from ((block.map[0], each) for each in SENTENCE_END.split("".join(words)))


def unnamed_errors(function: Function, owner: Scope) -> Iterator[str]:
    """Yield each error that `function` raises and its docstring does not name; without a docstring, none."""
    speakers = (function, owner) if isinstance(owner, ast.ClassDef) and function.name.startswith("__") else (function,)
    said = "".join(ast.get_docstring(each) or "" for each in speakers)
    for line, error in raised(function) if said else ():
        if error not in UNSAID and error not in said:
            yield f"{line}: `{function.name}` raises {error}, which its docstring does not name"


def raised(code: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and name of each error that `code` raises by its name and does not catch; not of functions in it."""
    caught = " ".join(ast.unparse(each.type) for each in getattr(code, "handlers", ()) if each.type)
    for each in ast.iter_child_nodes(code):
        if isinstance(each, ast.Raise) and each.exc:
            error = ast.unparse(each.exc).partition("(")[0].rpartition(".")[2]
            yield from [(each.lineno, error)] if error[0].isupper() and error not in caught else []
        elif not isinstance(each, Scope | ast.Lambda):
            here = "" if isinstance(each, ast.ExceptHandler) else caught
            yield from ((line, error) for line, error in raised(each) if error not in here)


if __name__ == "__main__":
    sys.exit(main() or 0)
