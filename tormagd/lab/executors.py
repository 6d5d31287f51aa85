"""Where a tool's runs are done: in processes of this machine, or on a Dask cluster."""

import argparse
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context


def add_options(parser: argparse.ArgumentParser, workers: int, needed: str) -> None:
    """`--workers` processes, or `--dask`; `needed` is what the cluster's workers have to have."""
    parser.add_argument("--workers", type=int, default=workers, help="processes on this machine (%(default)s)")
    parser.add_argument(
        "--dask", metavar="ADDRESS", help=f"scheduler of a Dask cluster instead; its workers need {needed}"
    )


@contextmanager
def chosen(options: argparse.Namespace) -> Iterator[Executor]:
    """What was asked for. Raises OSError where no scheduler answers at the address, ValueError for no worker at all."""
    if options.dask is None:
        # no forks of this one: of threads that libraries have begun they would have the locks and not the threads
        with ProcessPoolExecutor(options.workers, get_context("forkserver")) as here:
            yield here
        return
    # only a cluster needs it installed
    from distributed import Client

    with Client(options.dask) as client, client.get_executor() as cluster:
        yield cluster
