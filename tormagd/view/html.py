"""One HTML page to keep, send and print: no script, nothing loaded from elsewhere."""

import re
from collections.abc import Iterable, Sequence
from html import escape

STYLE = """body{font:15px/1.45 system-ui,sans-serif;color:#222;max-width:80rem;margin:2rem auto;padding:0 1rem}
img{max-width:100%}table{border-collapse:collapse;margin:.5rem 0}h2{margin-top:2rem}
th,td{padding:.25rem .8rem;text-align:left;vertical-align:top;border-bottom:1px solid #ddd}
.bad{color:#b71c1c;font-weight:600}"""


def page(title: str, parts: Iterable[str]) -> str:
    """Return the whole page. The parts are HTML and not escaped; `title` is plain text."""
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><style>{STYLE}</style>'
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{"".join(parts)}</body></html>\n'


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], is_bad: Sequence[bool] = ()) -> str:
    lines = ["".join(f"<td>{_with_code(cell)}</td>" for cell in row) for row in rows]
    if not lines:
        return "<p>None.</p>"
    kinds = [' class="bad"' if number < len(is_bad) and is_bad[number] else "" for number in range(len(lines))]
    head = "".join(f"<th>{escape(each)}</th>" for each in heads)
    body = "".join(f"<tr{kind}>{line}</tr>" for kind, line in zip(kinds, lines, strict=True))
    return f"<table><tr>{head}</tr>{body}</table>"


def _with_code(text: str) -> str:
    return re.sub("`([^`]+)`", r"<code>\1</code>", escape(text))
