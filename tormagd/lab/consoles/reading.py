"""Finding recordings and commissionings in a folder or bucket, and reading what each says, by workers anywhere."""

import re
from concurrent.futures import Executor

import fsspec
import msgspec

from tormagd.commission.report import MAX_BYTES, Report
from tormagd.lab.consoles.summary import Summary, summarise
from tormagd.lab.executors import finished

SUFFIX = ".mcap"
READ = re.compile(r"(.*\.mcap|(.*/)?[0-9a-f]{8}\.json)", re.IGNORECASE)
"Recordings, and the findings of `tormagctl commission`, which a serial number names."


def files(url: str) -> dict[str, str]:
    """Return the full address of every file of READ in a folder or under a URL, by its path there; or of that one file.

    Empty for a folder without one. Raises FileNotFoundError where there is no such folder or file, and OSError where it
    cannot be read. Raises ValueError for an unknown kind of URL, and ImportError for one whose package is missing.
    """
    system, root = fsspec.core.url_to_fs(url)
    if not system.exists(root):
        raise FileNotFoundError(f"{url}: no such folder or file")
    folder = root if system.isdir(root) else root.rpartition("/")[0]
    found = sorted(path for path in system.find(root) if READ.fullmatch(path))
    return {path.removeprefix(folder).lstrip("/"): system.unstrip_protocol(path) for path in found}


def read(url: str) -> Summary | Report | str:
    """Read the file at `url` and return a recording's summary, a commissioning's report, or the reason why there is
    none.

    Raises ImportError for a kind of address whose package is missing.
    """
    name = url.rpartition("/")[2]
    try:
        system, path = fsspec.core.url_to_fs(url)
        if not system.isfile(path):
            return "it is no regular file"
        with system.open(path, "rb") as file:
            if name.lower().endswith(SUFFIX):
                return summarise(file, name)
            return msgspec.json.decode(file.read(MAX_BYTES), type=Report)
    except (OSError, ValueError, RecursionError) as error:
        return str(error).removeprefix(f"{name}: ")


def read_all(urls: dict[str, str], executor: Executor) -> tuple[dict[str, Summary], dict[str, Report], dict[str, str]]:
    """Read all files of `urls`, addresses by name, by `executor`: return summaries, reports and reasons by name.

    A reason says why a file has neither. All have the order of `urls`. A failed worker makes a reason, not an
    error.
    """
    found: dict[str, Summary | Report | str] = {}
    for url, future in finished(executor, read, urls.values(), "recording"):
        error = future.exception()
        found[url] = future.result() if error is None else f"the worker that read it failed: {error}"
    ordered = [(name, found[url]) for name, url in urls.items()]
    return (
        {name: each for name, each in ordered if isinstance(each, Summary)},
        {name: each for name, each in ordered if isinstance(each, Report)},
        {name: each for name, each in ordered if isinstance(each, str)},
    )
