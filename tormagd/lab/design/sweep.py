"""A sweep of optimisation runs over any `concurrent.futures.Executor`.

A process pool serves one machine; Dask's `Client.get_executor()` or `mpi4py.futures.MPIPoolExecutor` serve a cluster.
"""

from collections.abc import Iterable
from concurrent.futures import Executor

from tormagd.lab.design.optimisation import Outcome, Run, solve
from tormagd.lab.executors import finished


def sweep(runs: Iterable[Run], executor: Executor) -> dict[Run, Outcome]:
    """The outcome of every run, in the order of the runs; a run that stands twice is solved once.

    Raises whatever a run raised; those that have not begun are then given up.
    """
    wanted = list(dict.fromkeys(runs))
    outcomes = {run: future.result() for run, future in finished(executor, solve, wanted, "run")}
    return {run: outcomes[run] for run in wanted}
