"""mkdocs's hooks: the site is `docs`, and the pages beside the code that they describe.

Links are written for the repository, where most people read. Here each is changed to its file's place on the site; the
examples are added as files.
"""

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
DOCS = "docs/"
BESIDE = (
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "RELEASING.md",
    "client/README.md",
    "lab/README.md",
    "systemd/README.md",
    "firmware_protocol/README.md",
    "firmware_protocol/c/README.md",
)
EXAMPLES = "examples/**/*.*"
_LINK = re.compile(r"(\]\(<?)(?!https?:|#)([^)#>]+)")
"The beginning of a Markdown link, and its path."


def on_files(files: Files, config: MkDocsConfig) -> Files:
    examples = [path.relative_to(ROOT).as_posix() for path in ROOT.glob(EXAMPLES) if "node_modules" not in path.parts]
    for name in (*BESIDE, *examples):
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn the repository's links into the site's."""
    here = page.file.src_uri
    folder = posixpath.dirname(here if here in BESIDE else DOCS + here)

    def moved(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, link[2])).removeprefix(DOCS)
        return link[1] + posixpath.relpath(target, posixpath.dirname(here) or ".")

    return _LINK.sub(moved, markdown)
