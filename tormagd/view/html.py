"""One HTML page to keep, send and print: no script, nothing loaded from elsewhere."""

import re
from collections.abc import Iterable, Sequence
from html import escape

STYLE = """:root{color-scheme:light dark;--text:#222;--back:#fff;--line:#ddd;--bad:#b71c1c}
body{font:15px/1.45 system-ui,sans-serif;color:var(--text);background:var(--back);max-width:80rem;margin:2rem auto;
padding:0 1rem;overflow-wrap:anywhere}
img{max-width:100%}h2{margin-top:2rem}table{border-collapse:collapse;margin:.5rem 0}
th,td{padding:.25rem .8rem .25rem 0;text-align:left;vertical-align:top;border-bottom:1px solid var(--line)}
.bad{color:var(--bad);font-weight:600}
td{min-width:4.5rem}td:first-child,th{overflow-wrap:normal}.wide{overflow-x:auto}
@media(max-width:40rem){h1{font-size:1.3rem}table{font-size:.85rem}.wide img{max-width:none;width:45rem}}
@media screen and (prefers-color-scheme:dark){:root{--text:#e4e4e4;--back:#121212;--line:#3a3a3a;--bad:#ff8a80}
img{filter:invert(.93) hue-rotate(180deg) brightness(1.2)}}
@media print{:root{color-scheme:light}body{margin:0;max-width:none;font-size:11px}h2{break-after:avoid}
tr,img{break-inside:avoid}.wide{overflow:visible}}"""


def page(title: str, parts: Iterable[str]) -> str:
    """Return the whole page. The parts are HTML and not escaped; `title` is plain text."""
    meta = '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    head = f"{meta}<title>{escape(title)}</title><style>{STYLE}</style>"
    return f'<!doctype html><html lang="en"><head>{head}</head><body><main>{"".join(parts)}</main></body></html>\n'


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], is_bad: Sequence[bool] = ()) -> str:
    lines = ["".join(f"<td>{_with_code(cell)}</td>" for cell in row) for row in rows]
    if not lines:
        return "<p>None.</p>"
    kinds = [' class="bad"' if number < len(is_bad) and is_bad[number] else "" for number in range(len(lines))]
    head = "".join(f'<th scope="col">{escape(each)}</th>' for each in heads)
    body = "".join(f"<tr{kind}>{line}</tr>" for kind, line in zip(kinds, lines, strict=True))
    return f'<div class="wide" tabindex="0"><table><tr>{head}</tr>{body}</table></div>'


def _with_code(text: str) -> str:
    return re.sub("`([^`]+)`", r"<code>\1</code>", escape(text))
