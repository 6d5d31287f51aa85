"""`tormagctl guide`: the pages of the documentation, which come with the package."""

from importlib.resources import files

from tormagd.ctl.outcome import Outcome, usage_error
from tormagd.ground.files import did_you_mean, shipped

FOLDERS = ("guides", "reference", ".")
"In the order of the list."


def guide(name: str | None) -> Outcome:
    """Return a page of the documentation, or the list of all pages."""
    folders = [files("tormagd") / "docs" / folder for folder in FOLDERS]
    pages = {
        page: (folder / f"{page}.md").read_text(encoding="utf-8")
        for folder in folders
        for page in shipped(folder, ".md")
    }
    if name is None:
        titles = {page: text.partition("\n")[0].lstrip("# ") for page, text in pages.items()}
        return Outcome({"guides": titles}, "\n".join(f"{page:<16}{title}" for page, title in titles.items()))
    if name not in pages:
        near = did_you_mean(name, pages)
        raise usage_error(f"{name[:80]!r}: no such guide{near}", "tormagctl guide lists them")
    return Outcome({"name": name, "text": pages[name]}, pages[name].rstrip())
