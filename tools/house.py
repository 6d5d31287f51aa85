"""Holds each room to its size in house.toml: `python tools/house.py` lists what is over it and ends with 1.

A room is a path there; a file counts in the longest one that it is in, and in `all`. Counted are statements, words of
docstrings and comments, functions over LONG lines of code (or 35), and over COMPLEX decisions (as radon counts).
A function's docstring has at most DOCSTRING words, and the words that docs/glossary.md ends with are not used.
`--lower` writes what is there now wherever house.toml allows more.
"""

import ast
import io
import re
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
LONG, COMPLEX, DOCSTRING = 40, 10, 60
Function = ast.FunctionDef | ast.AsyncFunctionDef
Branch = (
    ast.If | ast.For | ast.AsyncFor | ast.While | ast.ExceptHandler | ast.IfExp | ast.comprehension | ast.match_case
)


def said(node: ast.AST) -> str:
    """Return the string that stands alone as `node`, or an empty one."""
    value = node.value if isinstance(node, ast.Expr) else None
    return value.value if isinstance(value, ast.Constant) and isinstance(value.value, str) else ""


def prose(text: str, nodes: list[ast.AST]) -> str:
    """Return docstrings and comments of a module."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return "\n".join([*map(said, nodes), *(each.string[1:] for each in tokens if each.type == tokenize.COMMENT)])


def decisions(function: ast.AST) -> int:
    """Return McCabe's complexity, in which each `and` and `or` counts as a branch."""
    nodes = ast.walk(function)
    return 1 + sum(len(each.values) - 1 if isinstance(each, ast.BoolOp) else isinstance(each, Branch) for each in nodes)


def lines(function: Function) -> int:
    """Return how many lines a function has without its docstring."""
    docs = function.body[0] if said(function.body[0]) else None
    return (function.end_lineno or 0) - function.lineno + 1 - ((docs.end_lineno or 0) - docs.lineno + 1 if docs else 0)


def findings(root: Path, house: dict[str, dict[str, int]]) -> Iterator[str]:
    """Yield what is over its size in the checkout `root`, a line each, and lower `house` to what is there."""
    names = subprocess.check_output(["git", "ls-files", "*.py", "*.md"], cwd=root, text=True).split()
    texts = {name: (root / name).read_text(encoding="utf-8") for name in names}
    forbidden = re.findall(r"`([^`]+)`", texts["docs/glossary.md"].rpartition("\n## ")[2])
    unused = re.compile(rf"(?<![\w`])(?:{'|'.join(map(re.escape, forbidden))})(?![\w`])", re.IGNORECASE)
    there: dict[str, Counter[str]] = defaultdict(Counter)
    for name, text in texts.items():
        nodes = list(ast.walk(ast.parse(text if name.endswith(".py") else "")))
        functions = [each for each in nodes if isinstance(each, Function)]
        words = prose(text, nodes) if name.endswith(".py") else text
        yield from (f"{name}: {word!r} is forbidden by docs/glossary.md" for word in unused.findall(words))
        long_said = [each.name for each in functions if len(said(each.body[0]).split()) > DOCSTRING]
        yield from (f"{name}: the docstring of `{each}` has over {DOCSTRING} words" for each in long_said)
        counted = Counter(
            statements=sum(isinstance(each, ast.stmt) and not said(each) for each in nodes),
            words=len(words.split()),
            long=sum(lines(each) > LONG for each in functions),
            over_35=sum(lines(each) > 35 for each in functions),
            complex=sum(decisions(each) > COMPLEX for each in functions),
        )
        longest = max((each for each in house if name.startswith(each)), key=len, default="all")
        for room in {"pages"} if name.endswith(".md") else {"all", longest}:
            there[room] += counted
    for room, allowed in house.items():
        for kind, most in allowed.items():
            if (number := there[room][kind]) > most:
                yield f"{room}: {number} {kind}, {most} are allowed"
            allowed[kind] = min(number, most)


def main() -> str:
    """Return the findings; with `--lower` write house.toml anew."""
    file = ROOT / "house.toml"
    text = file.read_text(encoding="utf-8")
    house = tomllib.loads(text)
    found = "\n".join(findings(ROOT, house))
    for room, allowed in house.items() if "--lower" in sys.argv else ():
        row = ", ".join(f"{kind} = {most}" for kind, most in allowed.items())
        text = re.sub(rf'^("{re.escape(room)}" = ){{.*?}}', rf"\1{{ {row} }}", text, flags=re.MULTILINE)
        file.write_text(text, encoding="utf-8")
    return found


if __name__ == "__main__":
    sys.exit(main() or 0)
