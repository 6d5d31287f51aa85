"""What judges and benchmarks share: their command line, many runs with their progress, and a table or a JSON object.

A module's docstring is its `--help`; `OPTIONS` has what `argparse` adds to it. `measure(options)` returns the figures,
`shown(figures)` the lines of its table. The exit status is 1 if `passed` of the figures is false; `missed` says why.
"""

import argparse
import importlib
import json
import multiprocessing
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeVar

from tqdm import tqdm

from tormag_lab.arrays import Json
from tormag_lab.told import lines

Found = TypeVar("Found")


def parsed(
    room: str, known: Mapping[str, str], arguments: Sequence[str] | None = None
) -> tuple[Any, argparse.Namespace]:
    """Return the module of `room` that the first argument names, and the options that it takes from the others."""
    given = sys.argv[1:] if arguments is None else arguments
    says = "\n".join(f"{name:14s}{of_it}" for name, of_it in known.items())
    text = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(epilog=says, formatter_class=text)
    parser.add_argument("name", choices=known, metavar="NAME")
    name = parser.parse_args(given[:1]).name
    module: Any = importlib.import_module(f"{room}.{name.replace('-', '_')}")
    of_name = argparse.ArgumentParser(f"{parser.prog} {name}", description=module.__doc__, formatter_class=text)
    of_name.add_argument("--json", action="store_true", help="print one JSON object")
    for option, of_it in getattr(module, "OPTIONS", {}).items():
        of_name.add_argument(option, **of_it)
    return module, of_name.parse_args(given[1:])


def told(module: Any, options: argparse.Namespace, figures: Json) -> int:
    print(json.dumps(figures) if options.json else "\n".join(getattr(module, "shown", lines)(figures)))
    for text in figures.get("missed", ()):
        print(f"missed: {text}", file=sys.stderr)
    return 0 if figures.get("passed", True) else 1


def each(run: Callable[..., Found], what: str, *cases: Collection[Any], workers: int | None = None) -> list[Found]:
    """Return what `run` makes of the cases, a column of them for each of its arguments, in processes side by side."""
    # a fresh interpreter for each, so that the same seed gives the same cases everywhere
    with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
        return list(tqdm(pool.map(run, *cases), desc=what, total=len(cases[0]), disable=None))
