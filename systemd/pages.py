"""Makes completions and man pages of both commands from their argument parsers: python -P systemd/pages.py SHARE."""

import gzip
import sys
from argparse import SUPPRESS, ArgumentParser
from pathlib import Path

from argparse_manpage.manpage import Manpage

from tormagd import __version__
from tormagd.ctl.commands import SHELLS
from tormagd.ctl.completion import script, subparsers
from tormagd.ctl.main import parser as ctl
from tormagd.daemon.main import parser as daemon


def page(parser: ArgumentParser) -> bytes:
    """Return the man page in section 1, compressed; the same bytes for the same parser."""
    known = {"project_name": "tormagd", "version": __version__, "manual_title": "Haptic controller"}
    known["description"] = (parser.description or "").rstrip(".")
    parser._positionals.title = "commands"
    for _, command in subparsers(parser):
        # its heading and the common options are the program's; its own usage line would repeat both
        command.description, command.epilog, command.usage = None, None, SUPPRESS
        for action in command._actions:
            if not parser._option_string_actions.keys().isdisjoint(action.option_strings):
                action.help = SUPPRESS
    made = Manpage(parser, known, format="single-commands-section")
    made.date = ""  # the date of the build means nothing
    return gzip.compress(str(made).encode(), mtime=0)


def main(share: Path) -> None:
    """Write all of them under `share`, in existing folders."""
    for shell, path in zip(
        SHELLS, ("bash-completion/completions/tormagctl", "zsh/site-functions/_tormagctl"), strict=True
    ):
        (share / path).write_text(script(ctl(), shell), encoding="utf-8")
    for parser in (daemon(), ctl()):
        (share / "man/man1" / f"{parser.prog}.1.gz").write_bytes(page(parser))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
