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
    """Return the full address of every file of READ in and under a folder or URL, by its path there, sorted by that.

    `url` may also be one file, which is then returned by its name. Empty where no name fits. Nothing is read. Raises
    FileNotFoundError where there is no such folder or file, and OSError where it cannot be listed. Raises ValueError
    for an unknown kind of URL, and ImportError for one whose package is missing.
    """
    system, root = fsspec.core.url_to_fs(url)
    if not system.exists(root):
        raise FileNotFoundError(f"{url}: no such folder or file")
    folder = root if system.isdir(root) else root.rpartition("/")[0]
    found = sorted(path for path in system.find(root) if READ.fullmatch(path))
    return {path.removeprefix(folder).lstrip("/"): system.unstrip_protocol(path) for path in found}


def read(url: str) -> Summary | Report | str:
    """Read the file at `url`; return a recording's summary, a commissioning's report, or the reason why there is none.

    A name that ends with SUFFIX is a recording, any other a report, of which MAX_BYTES are read. A reason is one
    sentence for a person: the file is missing, not regular, damaged, or says nothing. Raises ImportError for a kind of
    address whose package is missing.
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
    """Read all files of `urls`, addresses by name, by `executor`; return summaries, reports and reasons, each by name.

    Every name is in one of the three, which have the order of `urls`. A reason says why a file has neither; a failed
    worker makes one, too, and no error. The progress is shown on stderr.
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
