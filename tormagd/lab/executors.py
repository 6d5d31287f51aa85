"""Executors for a tool's runs, processes of this machine or a Dask cluster, and the wait for the runs."""

import argparse
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import get_context
from typing import TypeVar

from tqdm import tqdm

from tormagd.lab.errors import LabError
from tormagd.lab.main import WORKERS

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")


def add_options(parser: argparse.ArgumentParser, workers: int, needed: str) -> None:
    """Add the options `--workers`, 1..1024, and `--dask ADDRESS` to `parser`; without the latter `dask` is None."""
    parser.add_argument("--workers", type=WORKERS, default=workers, help="processes on this machine (%(default)s)")
    parser.add_argument(
        "--dask", metavar="ADDRESS", help=f"scheduler of a Dask cluster instead; its workers need {needed}"
    )


@contextmanager
def chosen(options: argparse.Namespace) -> Iterator[Executor]:
    """Give the executor that `options.workers` and `options.dask` ask for, as a context: processes here, or a Dask
    cluster."""
    if options.dask is None:
        # a fork of this process would inherit the locks of libraries' threads, but not the threads
        with ProcessPoolExecutor(options.workers, get_context("forkserver")) as here:
            yield here
        return
    # only a cluster needs it installed
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
    """Run `function` on every item; yield each item with its done future, in order of completion, beside a progress
    bar."""
    pending = {executor.submit(function, item): item for item in items}
    try:
        for future in tqdm(as_completed(pending), total=len(pending), unit=unit, disable=None):
            yield pending[future], future
    finally:
        for future in pending:
            future.cancel()
