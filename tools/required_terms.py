"""Which terms of the controller's model a scene requires: each is left out in turn, on the whole simulated device.

    required_terms.py [SCENE ...] [--quick] [--costs] [--json] [--store] [--dask ADDRESS]

Sample 1 chooses: a term whose absence adds more than SHARE of the scene's tolerance to the RMS error of the force, with
the device learned beforehand and frozen or while it is learned, is in. All others are left out together, and what that
does is judged on samples 1 (frozen, too), 2 and 3: it stays within JUDGED of the tolerance, or adds no more than SHARE
of it; otherwise the term that counts most is put back. A scene that the full model does not meet decides nothing. Costs
are of this machine. Finished runs are kept, by what they depend on, in build/required_terms.json. `--store` puts every
scene, as it is done, into the file that comes with the package. All devices are synthetic.
"""

import argparse
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import msgspec
from force_tracking import SAMPLES
from scene_runs import ROOT, Case, costs, run_all
from tqdm import tqdm

from tormagd.config import ConfigError
from tormagd.headroom.__main__ import build
from tormagd.headroom.machine_loop import machine_us
from tormagd.output import write_line
from tormagd.scenes.measured import FILE, JUDGED, AtRates, Judged, Measured, MeasuredScene, Without, measured, required
from tormagd.scenes.scene import TERMS, load_scene, shipped_scenes

SHARE = 0.2
KEPT = ROOT / "build" / "required_terms.json"
STORED = ROOT / "tormagd" / "scenes" / FILE
SECONDS, QUICK_S = 5.0, 2.0
FROM_HZ = 1_000, 500
"Rates at which terms are chosen: of control, and of setpoints and plans."
RATES_HZ = ((250, 250), (500, 500), (500, 83), (1_000, 83))
MODES = (True, False)

Runs = Callable[[Iterable[Case]], dict[Case, float]]


def measure(name: str, runs: Runs, samples: tuple[str, ...] = SAMPLES, seconds: float = SECONDS) -> MeasuredScene:
    """One scene, whole; `runs` gives the outcomes of cases. Raises ConfigError for a scene that has no signal."""
    scene = load_scene(name)
    if scene.signal is None:
        raise ConfigError(f"scene {scene.name}: signal is missing: without one nothing is known of what it asks for")
    tolerance_N = scene.force.tolerance_rms_N
    told_ahead = scene.signal.is_known_ahead

    def case(left_out: Iterable[str], is_learning: bool, plant: str = samples[0]) -> Case:
        return Case(name, plant, tuple(sorted(left_out)), is_learning, *FROM_HZ, seconds)

    # without a preview in the setpoints nothing changes where it is not used
    tried = [term for term in TERMS if told_ahead or term != "preview"]
    alone = runs([case(out, mode) for mode in MODES for out in [(), *((term,) for term in tried)]])
    terms = []
    for term in TERMS:
        added = [alone[case((term,), mode)] - alone[case((), mode)] if term in tried else 0.0 for mode in (False, True)]
        terms.append(Without(term, *added))
    needed = set(required(tuple(terms), tolerance_N, SHARE))
    while True:
        left_out = tuple(term for term in TERMS if term not in needed)
        on = [(samples[0], False), *((plant, True) for plant in samples)]
        full, chosen = (runs([case(out, mode, plant) for plant, mode in on]) for out in ((), left_out))
        judged = tuple(
            Judged(plant, mode, full[case((), mode, plant)], chosen[case(left_out, mode, plant)]) for plant, mode in on
        )
        if all(is_good(item, tolerance_N) for item in judged):
            if is_met(judged, tolerance_N) or not left_out:
                break
            needed = set(TERMS)  # nothing can be told from a scene that the full model does not meet
            continue
        needed.add(max((item for item in terms if item.term in left_out), key=lambda item: item.added_N).term)
    at_rates = [Case(name, samples[0], tuple(sorted(left_out)), True, *hz, seconds) for hz in (FROM_HZ, *RATES_HZ)]
    found = runs(at_rates)
    return with_costs(
        MeasuredScene(
            scene.name,
            scene.fingerprint,
            tolerance_N,
            left_out,
            tuple(terms),
            judged,
            tuple(AtRates(item.control_hz, item.inference_hz, found[item]) for item in at_rates),
        ),
        name,
    )


def with_costs(found: MeasuredScene, name: str) -> MeasuredScene:
    """The same scene, of that name or file, with what its terms cost on this machine now."""
    spent = costs(Case(name), [(), found.left_out, *((item.term,) for item in found.terms)])
    full_us_s, chosen_us_s, *alone_us_s = (item.us_s(*FROM_HZ) for item in spent)
    terms = tuple(
        msgspec.structs.replace(item, saved_us_s=full_us_s - us_s)
        for item, us_s in zip(found.terms, alone_us_s, strict=True)
    )
    return msgspec.structs.replace(found, terms=terms, cost_full_us_s=full_us_s, cost_us_s=chosen_us_s)


def is_met(judged: Iterable[Judged], tolerance_N: float) -> bool:
    """Whether the full model keeps to the tolerance while the device is learned."""
    return all(item.full_N <= tolerance_N for item in judged if item.is_learning)


def is_good(item: Judged, tolerance_N: float) -> bool:
    """Whether what was chosen does for the scene what the full model does."""
    return item.chosen_N <= max(JUDGED * tolerance_N, item.full_N + SHARE * tolerance_N)


def main() -> int:
    """Measures the scenes that are named, or all that are shipped; 0, or 2 for one that cannot be measured."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="name or file; default: every shipped one")
    parser.add_argument("--quick", action="store_true", help=f"sample 1 alone, and {QUICK_S:g} s: a look, no figure")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--store", action="store_true", help="write the file that comes with the package")
    parser.add_argument("--costs", action="store_true", help="of stored scenes measure nothing but the costs anew")
    parser.add_argument("--kept", type=Path, default=KEPT, help="JSON file that keeps finished runs")
    parser.add_argument("--workers", type=int, default=1, help="processes on this machine")
    parser.add_argument(
        "--dask", metavar="ADDRESS", help="scheduler of a Dask cluster; its workers need tools/ on their path"
    )
    options = parser.parse_args()
    known = {scene.name: scene for scene in measured().scenes}
    names = options.scenes or (list(known) if options.costs else list(shipped_scenes()))
    if options.costs and not set(names) <= set(known):
        parser.error(f"--costs: allowed are the scenes that are stored, {', '.join(known)}")
    seconds, samples = (QUICK_S, SAMPLES[:1]) if options.quick else (SECONDS, SAMPLES)
    found = []
    try:
        with ExitStack() as stack:
            executor = _executor(options, stack)
            bar = stack.enter_context(tqdm(unit="run", disable=not sys.stderr.isatty()))

            def runs(cases: Iterable[Case]) -> dict[Case, float]:
                bar.reset()

                def progress(finished: int, total: int) -> None:
                    bar.total = total
                    bar.update(finished - bar.n)

                return run_all(cases, executor, options.kept, progress)

            for name in names:
                bar.set_description(name)
                found.append(with_costs(known[name], name) if options.costs else measure(name, runs, samples, seconds))
                if options.store:
                    others = [scene for scene in measured().scenes if scene.name != found[-1].name]
                    every = sorted([*others, found[-1]], key=lambda scene: scene.name)
                    STORED.write_text(_text(_measured(every, seconds)), encoding="utf-8")
    except ConfigError as error:
        print(f"required_terms: {error}", file=sys.stderr)
        return 2
    result = _measured(found, seconds)
    write_line(_text(result) if options.json else table(result), sys.stdout)
    return 0


def _measured(scenes: list[MeasuredScene], seconds: float) -> Measured:
    return Measured("tools/required_terms.py --store", SHARE, seconds, build(), round(machine_us(), 1), tuple(scenes))


def _text(result: Measured) -> str:
    return msgspec.json.format(msgspec.json.encode(result), indent=1).decode() + "\n"


def _executor(options: argparse.Namespace, stack: ExitStack) -> Executor:
    if options.dask is None:
        return stack.enter_context(ProcessPoolExecutor(options.workers))
    # only a cluster needs it installed
    from distributed import Client

    executor: Executor = stack.enter_context(stack.enter_context(Client(options.dask)).get_executor())
    return executor


def table(result: Measured) -> str:
    """Every scene for a person; errors in mN, costs in us per s of control."""
    lines = []
    for scene in result.scenes:
        lines += [
            f"{scene.name}: tolerance {1e3 * scene.tolerance_N:.0f} mN, {scene.cost_full_us_s:.0f} us/s full, "
            f"{scene.cost_us_s:.0f} chosen",
            "  term      added, frozen  learning     saved",
        ]
        for item in scene.terms:
            stays = "out" if item.term in scene.left_out else "in"
            lines.append(
                f"  {item.term:9s} {1e3 * item.frozen_added_N:12.1f}  {1e3 * item.learning_added_N:8.1f}  "
                f"{item.saved_us_s:8.0f}  {stays}"
            )
        for judged in scene.judged:
            how = "learning" if judged.is_learning else "frozen"
            lines.append(
                f"  {judged.plant}, {how}: full {1e3 * judged.full_N:.1f}, chosen {1e3 * judged.chosen_N:.1f} mN"
            )
        for at in scene.rates:
            lines.append(f"  {at.control_hz} Hz control, {at.inference_hz} Hz inference: {1e3 * at.rms_N:.1f} mN")
        lines += ["  to name its terms in a scene file:", "    [terms]"]
        lines += [f"    {term} = false" for term in scene.left_out]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
