"""Leaves so many mutants of a session of cosmic-ray, drawn by a seed, and skips the rest: SESSION COUNT SEED."""

import random
import sys

from cosmic_ray.work_db import use_db
from cosmic_ray.work_item import WorkerOutcome, WorkResult


def main(session: str, count: int, seed: int) -> None:
    """Numbers of a session are drawn anew with it, so mutants are ordered by what they are."""
    with use_db(session) as database:
        mutants = sorted(database.pending_work_items, key=lambda item: str(item.mutations))
        kept = random.Random(seed).sample(mutants, min(count, len(mutants)))
        for job in {mutant.job_id for mutant in mutants} - {mutant.job_id for mutant in kept}:
            database.set_result(job, WorkResult(WorkerOutcome.SKIPPED))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
