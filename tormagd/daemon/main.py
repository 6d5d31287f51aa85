"""`tormagd`: reads its command line, and starts the daemon."""

import signal
import sys
from pathlib import Path

from firmware_protocol.build import settle
from tormagd import __version__
from tormagd.config import load_config
from tormagd.ground.command_line import Parser, UsageError, add, option
from tormagd.ground.terminal import log_to_stderr, write_in_any_encoding, write_line
from tormagd_client.endpoints import ConfigError
from tormagd_client.printable import printable

EXIT_TEXT = """exit codes: 0 ended on request, 1 could not run, 2 configuration refused. SIGTERM opens the gap and ends;
SIGHUP reads keys and configuration again."""
OPTIONS = (
    option("--config", type=Path, metavar="FILE", help="TOML configuration"),
    option("--scene", metavar="NAME", help="scene or scene file instead of the configuration's"),
    option("--check", action="store_true", help="print the resolved configuration and exit"),
    option("--version", action="version", version=f"tormagd {__version__}, {settle()}"),
)


def parser() -> Parser:
    made = Parser(prog="tormagd", description="Real-time haptic controller daemon.", epilog=EXIT_TEXT)
    add(made, OPTIONS)
    return made


def main(arguments: list[str] | None = None) -> int:
    write_in_any_encoding()
    try:
        options = parser().parse_args(arguments)
    except UsageError as error:
        write_line(f"tormagd: {error.message}\n  next: {error.hint}", sys.stderr)
        return 2
    log_to_stderr()
    # nothing moves until the daemon runs and takes the signal over: before that, Ctrl-C may end the process
    interrupt = signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        load_config(options.config)  # refused before the rest is loaded, which takes a moment
        # imported after the signal is set
        from tormagd.daemon.start import start

        return start(options)
    except ConfigError as error:
        write_line(f"tormagd: {printable(str(error))}", sys.stderr)
        return 2
    finally:
        signal.signal(signal.SIGINT, interrupt)


if __name__ == "__main__":
    sys.exit(main())
