"""A sweep of optimisation runs over any `concurrent.futures.Executor`.

A process pool serves one machine; Dask's `Client.get_executor()` or `mpi4py.futures.MPIPoolExecutor` serve a cluster.
"""

from collections.abc import Iterable
from concurrent.futures import Executor

from tormagd.lab.design.optimisation import Outcome, Run, solve
from tormagd.lab.executors import finished


def sweep(runs: Iterable[Run], executor: Executor) -> dict[Run, Outcome]:
    """Solve every run on `executor` and return the outcomes by run, in the order of the runs.

    Equal runs are solved once. The progress is shown on stderr. Raises what the first run to fail, in time, raised,
    DomainError as `solve`; runs that have not begun are then cancelled. `executor` is left open.
    """
    wanted = list(dict.fromkeys(runs))
    outcomes = {run: future.result() for run, future in finished(executor, solve, wanted, "run")}
    return {run: outcomes[run] for run in wanted}
