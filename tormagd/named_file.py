"""Files that a user names: a shipped one by its name, or one of his own by its path."""

from collections.abc import Iterable
from importlib.resources.abc import Traversable
from pathlib import Path

from tormagd_client.endpoints import ConfigError
from tormagd_client.printable import in_short


def shipped(folder: Traversable, ending: str) -> tuple[str, ...]:
    """Return the names of a package folder's files with `ending`, without it."""
    return tuple(sorted(each.name.removesuffix(ending) for each in folder.iterdir() if each.name.endswith(ending)))


def named(key: str, name: str, folder: Traversable, ending: str, beside: Path = Path()) -> Path:
    """Return the path of a shipped file, or else of the existing file `name`, relative to `beside`."""
    names, reason = shipped(folder, ending), ""
    if name in names:
        return Path(str(folder / f"{name}{ending}"))
    try:
        if name and (beside / name).exists():
            return beside / name
    except OSError as error:  # a name that no file can have, or a directory that may not be entered
        reason = f"{error.strerror}; "
    near = did_you_mean(name, names)
    raise ConfigError(f"{key} = {in_short(name)}: {reason}allowed is a file or one of {', '.join(names)}{near}")


def did_you_mean(word: str, allowed: Iterable[str]) -> str:
    """Return `; did you mean ...?` with the allowed word nearest to `word`, or ""."""
    import difflib  # takes a moment, and most configurations are right

    near = difflib.get_close_matches(word, list(allowed), n=1)
    return f"; did you mean `{near[0]}`?" if near else ""
