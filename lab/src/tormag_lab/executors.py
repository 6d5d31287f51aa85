"""Executors for a tool's runs: processes of this machine, or a Dask cluster."""

import argparse
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import get_context
from typing import TypeVar

from tqdm import tqdm

from tormag_lab.errors import LabError
from tormag_lab.main import WORKERS

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")


def add_options(parser: argparse.ArgumentParser, workers: int, needed: str) -> None:
    parser.add_argument("--workers", type=WORKERS, default=workers, help="processes on this machine (%(default)s)")
    parser.add_argument(
        "--dask", metavar="ADDRESS", help=f"scheduler of a Dask cluster instead; its workers need {needed}"
    )


@contextmanager
def chosen(options: argparse.Namespace) -> Iterator[Executor]:
    """Give the executor that the options ask for, for as long as the context lasts."""
    if options.dask is None:
        # a fork would inherit the locks of libraries' threads without the threads
        with ProcessPoolExecutor(options.workers, get_context("forkserver")) as here:
            yield here
        return
    # only a cluster needs this package
    from distributed import Client

    try:
        client = Client(options.dask)
    except ValueError as error:
        raise LabError(f"--dask {options.dask}: {error}") from error
    with client, client.get_executor() as cluster:
        yield cluster


def finished(
    executor: Executor, function: Callable[[ItemT], ResultT], items: Iterable[ItemT], unit: str
) -> Iterator[tuple[ItemT, "Future[ResultT]"]]:
    """Run `function` on every item, and yield each item with its future when it is done, beside a progress bar."""
    pending = {executor.submit(function, item): item for item in items}
    try:
        for future in tqdm(as_completed(pending), total=len(pending), unit=unit, disable=None):
            yield pending[future], future
    finally:
        for future in pending:
            future.cancel()
