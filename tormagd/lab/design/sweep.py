"""A sweep of optimisation runs over any `concurrent.futures.Executor`, resumable from a state file.

A process pool serves one machine; Dask's `Client.get_executor()` or `mpi4py.futures.MPIPoolExecutor` serve a cluster.
Each outcome is written as it comes, so that a sweep that was stopped goes on where it was. A run is its own key: with
another region, bound or seed it is another run, and never takes an old outcome.
"""

from collections.abc import Iterable
from concurrent.futures import Executor
from pathlib import Path
from typing import Literal

import msgspec

from tormagd.bounded_file import read_bounded
from tormagd.lab.design.optimisation import Outcome, Run, solve
from tormagd.lab.executors import finished
from tormagd.physics.errors import DomainError

MAX_STATE_BYTES = 64_000_000


class _State(msgspec.Struct, forbid_unknown_fields=True):
    version: Literal[1]
    finished: list[tuple[Run, Outcome]]


def sweep(
    runs: Iterable[Run],
    executor: Executor,
    state: Path | None = None,
) -> dict[Run, Outcome]:
    """The outcome of every run, in the order of the runs; a run that stands twice is solved once.

    With `state`, outcomes found in that file are taken from it and new ones are added. Raises `DomainError` for a state
    file that is not one (it is left as it is) and whatever a run raised; runs that have not begun are then given up,
    finished ones stay in the file.
    """
    wanted = list(dict.fromkeys(runs))
    known = {} if state is None else read_state(state)
    outcomes = {run: known[run] for run in wanted if run in known}
    for run, future in finished(executor, solve, [run for run in wanted if run not in known], "run"):
        outcomes[run] = known[run] = future.result()
        if state is not None:
            _write_state(state, known)
    return {run: outcomes[run] for run in wanted}


def read_state(path: Path) -> dict[Run, Outcome]:
    """The runs finished so far, none where there is no file; `DomainError` for a file that is not a sweep's state."""
    if not path.exists():
        return {}
    try:
        state = msgspec.json.decode(read_bounded(path, MAX_STATE_BYTES), type=_State)
    except msgspec.DecodeError as error:
        raise DomainError(str(path), error, "the state file of a sweep") from error
    return dict(state.finished)


def _write_state(path: Path, finished: dict[Run, Outcome]) -> None:
    # replaced whole: a stop in the middle leaves the last good state
    partial = path.with_name(path.name + ".part")
    partial.write_bytes(msgspec.json.encode(_State(1, list(finished.items()))))
    partial.replace(path)
