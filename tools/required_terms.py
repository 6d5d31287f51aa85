"""Which terms of the controller's model a scene requires: each is left out in turn, on the whole simulated device.

    required_terms.py [SCENE ...] [--quick] [--json] [--store] [--dask ADDRESS]

First the rates: the lowest at which all terms do what they do at the usual. At these, sample 1 chooses: a term whose
absence adds more than SHARE of the scene's tolerance to the RMS error of the force, with the device learned beforehand
and frozen or while it is learned, is in. All others are left out together. What rates and terms do is judged on samples
1 (frozen, too), 2 and 3: it stays within JUDGED of the tolerance, or adds no more than SHARE of it; otherwise the rates
are none, and the term that counts most is put back, until the rest may go; what was put back before that is tried
again. A scene that the full model does not meet decides nothing. With the choice every search is tried. Costs are of
this machine. `--store` puts every scene, as it is done, into the file that comes with the package. All devices are
synthetic.
"""

import argparse
import sys
from collections.abc import Callable, Collection, Iterable
from functools import partial

import msgspec
from rendering.device_draws import SAMPLES
from rendering.scene_runs import ROOT, Case, costs, load_task, run_all

from tormagd.headroom.__main__ import build
from tormagd.headroom.machine_loop import machine_us
from tormagd.lab import executors
from tormagd.output import write_line
from tormagd.scenes.measured import (
    FILE,
    JUDGED,
    AtRates,
    Cost,
    Judged,
    Measured,
    MeasuredScene,
    Without,
    WithSearch,
    is_met,
    measured,
    required,
)
from tormagd.scenes.scene import LEAST_CONTROL_HZ, TERMS, shipped_scenes
from tormagd_client.endpoints import ConfigError

SHARE = 0.2
SEARCHES = ("nearest", "newton")
"Those that need no torch."
STORED = ROOT / "tormagd" / "scenes" / FILE
SECONDS, QUICK_S = 5.0, 2.0
LONGEST_S = 120.0
"Of a hold that is measured to its end; `--quick` leaves out all after QUICK_S."
RATES_HZ = (
    *((1_000, 500), (2_000, 1_000), (1_000, 1_000), (1_000, 83)),
    *((500, 500), (500, 83), (250, 250), (250, 83)),
)
"""Of control, and of setpoints and plans. The full model at the first of them, the usual, is what all others are held
against."""
MODES = False, True
"Frozen, and while the device is learned."
NO_COST = Cost(0.0, 0.0)

Runs = Callable[[Collection[Case]], dict[Case, float]]


def measure(
    name: str,
    runs: Runs,
    samples: tuple[str, ...] = SAMPLES,
    seconds: float = SECONDS,
    longest_s: float = LONGEST_S,
) -> MeasuredScene:
    """One scene, whole, for these seconds, or for as long as it holds a force, `longest_s` at most; `runs` gives the
    outcomes of cases. Raises ConfigError for a scene that has no signal."""
    scene = load_task(name)
    if scene.signal is None:
        raise ConfigError(f"scene {scene.name}: signal is missing: without one nothing is known of what it asks for")
    tolerance_N = scene.force.tolerance_rms_N
    if scene.signal.hold_s is not msgspec.UNSET:  # what a hold does is seen by its end
        seconds = max(seconds, min(scene.signal.hold_s, longest_s))
    on = [(samples[0], False), *((plant, True) for plant in samples)]

    def case(left_out: Iterable[str], hz: tuple[int, int], plant: str, is_learning: bool, search: str = "") -> Case:
        return Case(name, plant, tuple(sorted(left_out)), search, is_learning, *hz, seconds)

    def judge(left_out: Iterable[str], hz: tuple[int, int]) -> tuple[Judged, ...]:
        full, chosen = (
            [case(*model, plant, mode) for plant, mode in on] for model in (((), RATES_HZ[0]), (left_out, hz))
        )
        found = runs([*full, *chosen])
        pairs = zip(full, chosen, strict=True)
        return tuple(Judged(best.plant, best.is_learning, found[best], found[each]) for best, each in pairs)

    rates = tuple(AtRates(*hz, judge((), hz), NO_COST) for hz in RATES_HZ)
    hz = cheapest(rates, tolerance_N)
    terms = _alone(lambda out, mode: case(out, hz, samples[0], mode), runs)
    left_out: tuple[str, ...] = ()  # nothing can be told from a scene that the full model does not meet
    if is_met(rates[0].judged, tolerance_N):
        left_out = spared(terms, tolerance_N, lambda out: all(is_good(item, tolerance_N) for item in judge(out, hz)))
    judged = judge(left_out, hz)
    searched = {search: case(left_out, hz, samples[0], True, search) for search in SEARCHES}
    found = runs(searched.values())
    searches = tuple(WithSearch(search, found[each], NO_COST) for search, each in searched.items())
    unpriced = MeasuredScene(
        scene.name, scene.fingerprint, tolerance_N, *hz, left_out, terms, judged, rates, searches, NO_COST
    )
    return with_costs(unpriced, name)


def _alone(case: Callable[[Iterable[str], bool], Case], runs: Runs) -> tuple[Without, ...]:
    """Each term left out alone."""
    found = runs([case(out, mode) for mode in MODES for out in [(), *((term,) for term in TERMS)]])
    terms = []
    for term in TERMS:
        frozen_N, learning_N = (found[case((term,), mode)] - found[case((), mode)] for mode in MODES)
        terms.append(Without(term, frozen_N, learning_N, NO_COST))
    return tuple(terms)


def spared(terms: tuple[Without, ...], tolerance_N: float, does: Callable[[Iterable[str]], bool]) -> tuple[str, ...]:
    """The terms to leave out. `does` says whether a scene does without some.

    Of those that are not required the one that counts most is put back, until the rest may go together. Beside what
    followed it one may not be needed any more: those put back are tried again, the one that counts least first.
    """
    needed = required(terms, tolerance_N, SHARE)
    out = [item.term for item in sorted(terms, key=lambda item: item.added_N) if item.term not in needed]
    back: list[str] = []
    while out and not does(out):
        back.append(out.pop())
    for term in reversed(back[:-1]):
        if does([*out, term]):
            out.append(term)
    return tuple(term for term in TERMS if term in out)


def cheapest(rates: tuple[AtRates, ...], tolerance_N: float) -> tuple[int, int]:
    """The lowest rates that a scene may be run at and that do what the usual do; those, where it is not met."""
    if not is_met(rates[0].judged, tolerance_N):
        return RATES_HZ[0]
    good = [at.hz for at in rates if all(is_good(item, tolerance_N) for item in at.judged)]
    return min(hz for hz in good if hz[0] >= LEAST_CONTROL_HZ)


def with_costs(found: MeasuredScene, name: str) -> MeasuredScene:
    """The same scene, of that name or file, with what its choices cost on this machine now."""
    case = Case(name, control_hz=found.control_hz, inference_hz=found.inference_hz)
    chosen = msgspec.structs.replace(case, left_out=found.left_out)
    others = [case, chosen]
    others += [msgspec.structs.replace(chosen, search=item.search) for item in found.searches]
    others += [msgspec.structs.replace(case, left_out=(item.term,)) for item in found.terms]
    full, cost, *rest = costs(others)
    priced = iter(rest)
    searches = tuple(msgspec.structs.replace(item, cost=next(priced)) for item in found.searches)
    terms = tuple(msgspec.structs.replace(item, cost=next(priced)) for item in found.terms)
    others_at = [
        msgspec.structs.replace(case, control_hz=at.control_hz, inference_hz=at.inference_hz) for at in found.rates
    ]
    at_hz = {each: full if each == case else costs([each])[0] for each in others_at}
    rates = tuple(
        msgspec.structs.replace(at, cost=at_hz[each]) for at, each in zip(found.rates, others_at, strict=True)
    )
    return msgspec.structs.replace(found, terms=terms, searches=searches, rates=rates, chosen=cost)


def is_good(item: Judged, tolerance_N: float) -> bool:
    """Whether what was chosen does for the scene what the full model does."""
    return item.chosen_N <= max(JUDGED * tolerance_N, item.full_N + SHARE * tolerance_N)


def main(arguments: list[str] | None = None) -> int:
    """Measures the scenes that are named, or all that are shipped; 0, or 2 for a scene that cannot be measured."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="name or file; default: every shipped one")
    parser.add_argument("--quick", action="store_true", help=f"sample 1 alone, and {QUICK_S:g} s: a look, no figure")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--store", action="store_true", help="write the file that comes with the package")
    executors.add_options(parser, 1, needed="tormagd, and tools/ on their path")
    options = parser.parse_args(arguments)
    seconds, longest_s, samples = (QUICK_S, QUICK_S, SAMPLES[:1]) if options.quick else (SECONDS, LONGEST_S, SAMPLES)
    found: list[MeasuredScene] = []
    outcomes: dict[Case, float] = {}
    try:
        with executors.chosen(options) as executor:
            for name in options.scenes or shipped_scenes():
                runs = partial(run_all, executor=executor, known=outcomes)
                found.append(measure(name, runs, samples, seconds, longest_s))
                if options.store:
                    others = [scene for scene in measured().scenes if scene.name != found[-1].name]
                    every = sorted([*others, found[-1]], key=lambda scene: scene.name)
                    STORED.write_text(_text(_measured(every, seconds)), encoding="utf-8")
    except ConfigError as error:
        print(f"required_terms: {error}", file=sys.stderr)
        return 2
    write_line(_text(_measured(found, seconds)) if options.json else "\n".join(map(table, found)), sys.stdout)
    return 0


def table(scene: MeasuredScene) -> str:
    """A scene for a person: errors in mN, costs in us per s of control."""
    return "\n".join(
        [
            f"{scene.name}: tolerance {1e3 * scene.tolerance_N:.0f} mN, {scene.cost_full_us_s:.0f} us/s full, "
            f"{scene.cost_us_s:.0f} chosen, at {scene.control_hz} / {scene.inference_hz} Hz",
            *(
                f"  without {item.term:18s}{1e3 * item.frozen_added_N:8.1f} mN more frozen, "
                f"{1e3 * item.learning_added_N:6.1f} learning: {'out' if item.term in scene.left_out else 'in'}"
                for item in scene.terms
            ),
            *(
                f"  {item.plant}, {'learning' if item.is_learning else 'frozen'}: "
                f"full {1e3 * item.full_N:.1f}, chosen {1e3 * item.chosen_N:.1f} mN"
                for item in scene.judged
            ),
            "  to name its terms in a scene file:",
            "    [terms]",
            *(f"    {term} = false" for term in scene.left_out),
        ]
    )


def _measured(scenes: Iterable[MeasuredScene], seconds: float) -> Measured:
    every = tuple(scenes)
    return Measured("tools/required_terms.py --store", SHARE, seconds, build(), round(machine_us(), 1), every)


def _text(result: object) -> str:
    return msgspec.json.format(msgspec.json.encode(result), indent=1).decode() + "\n"


if __name__ == "__main__":
    sys.exit(main())
