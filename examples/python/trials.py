"""Blinded trials: which of two walls was the stiffer one? Randomised, by a seed that the file keeps.

    python trials.py FOLDER OUT.csv [--pairs N] [--seed S]

FOLDER is where the sockets of an enabled daemon are. The operator pushes the handle into two walls and answers 1 or 2.
The order is drawn, and is written to OUT.csv only after the answer, so the experimenter does not know it either. An
interrupted pair is not written. At the end the program prints how often each difference of stiffness was told, with a
95 % interval (Wilson).
"""

import argparse
import csv
import itertools
import math
import random
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from tormagd_client import Client, ClientError

REFERENCE_N_MM = 0.3
RATIOS = (1.1, 1.22, 1.5, 2.0)
"The other wall's stiffness over the reference's: around the just noticeable difference, 22 %."
WALL_MM = 20.0
PERIOD_S = 0.01


def offer(folder: str, stiffness_N_mm: float, ended: threading.Event) -> bool:
    """Publish one wall until `ended`; return whether the enabled brake ever followed it. Raises ClientError or
    ValueError.
    """
    is_felt, start_mm = False, None
    with Client.local(folder, wait_s=2.0, source="trials") as client:
        while not ended.wait(PERIOD_S):
            for state in client.telemetry():
                start_mm = state.handle_mm if start_mm is None else start_mm
                said = state.verdict
                is_felt |= state.operating_state == "ENABLED" and said is not None and said.source == "trials"
            if start_mm is not None:
                contact = {"handle_mm": start_mm + WALL_MM, "stiffness_N_mm": stiffness_N_mm}
                client.publish(0.0, 200.0, contact=contact, withdraw_cf=0.0)
    return is_felt


def pairs(count: int, seed: int) -> list[tuple[float, bool]]:
    """Return the ratios in a drawn order, equally often, and whether the stiffer wall comes first."""
    drawn = random.Random(seed)
    all_pairs = list(itertools.islice(itertools.cycle(itertools.product(RATIOS, (True, False))), count))
    drawn.shuffle(all_pairs)
    return all_pairs


def interval(right: int, count: int) -> tuple[float, float]:
    z, share = 1.96, right / count
    middle, half = share + z * z / (2 * count), z * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return (middle - half) / (1 + z * z / count), (middle + half) / (1 + z * z / count)


def offered(folder: str, stiffness_N_mm: float, number: int, say: Callable[[str], str]) -> bool:
    """Offer one wall until the operator is done; return whether there was one to feel. Raises as `offer`."""
    ended = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        wall = pool.submit(offer, folder, stiffness_N_mm, ended)
        try:
            say(f"  wall {number}: push, draw back to where you began, then press Enter ")
        finally:
            ended.set()
    return wall.result()


def run(
    folder: str, write: Callable[[list[object]], object], trials: list[tuple[float, bool]], say: Callable[[str], str]
) -> dict[float, list[bool]]:
    """Run all pairs; return for each ratio whether the stiffer wall was told. A pair without both walls is void."""
    told: dict[float, list[bool]] = {ratio: [] for ratio in RATIOS}
    for number, (ratio, is_first) in enumerate(trials, start=1):
        print(f"pair {number} of {len(trials)}")
        walls_N_mm = [ratio * REFERENCE_N_MM, REFERENCE_N_MM][:: 1 if is_first else -1]
        there = [offered(folder, each_N_mm, place, say) for place, each_N_mm in enumerate(walls_N_mm, start=1)]
        if not all(there):
            print("  void: the brake was not enabled, or another source holds it: tormagctl status")
            continue
        while (answer := say("  which was stiffer, 1 or 2? ").strip()) not in ("1", "2"):
            pass
        told[ratio].append((answer == "1") == is_first)
        write([number, ratio, 1 if is_first else 2, answer])
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder")
    parser.add_argument("out")
    parser.add_argument("--pairs", type=int, default=16)
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(1_000_000))
    options = parser.parse_args()
    try:
        with open(options.out, "x", newline="", encoding="utf-8") as file:
            rows = csv.writer(file)
            rows.writerow([f"trial (seed {options.seed})", "ratio", "stiffer", "answer"])
            told = run(options.folder, rows.writerow, pairs(options.pairs, options.seed), input)
    except (ClientError, OSError, ValueError, EOFError) as error:
        sys.exit(f"ended early: {error}")
    for ratio, answers in told.items():
        if answers:
            low, high = interval(sum(answers), len(answers))
            print(f"{ratio:g} times as stiff: told {sum(answers)} of {len(answers)}, {low:.0%} to {high:.0%}")


if __name__ == "__main__":
    main()
