"""Which terms of the controller's model a scene requires: each is left out in turn, on the whole simulated device.

    required_terms.py [SCENE ...] [--quick] [--recordings] [--wrong] [--json] [--store] [--dask ADDRESS]

First the rates: the lowest at which all terms do what they do at the usual. At these, sample 1 chooses: a term whose
absence adds more than SHARE of the scene's tolerance to the RMS error of the force, with the device learned beforehand
and frozen or while it is learned, is in. All others are left out together. What rates and terms do is judged on samples
1 (frozen, too), 2 and 3: it stays within JUDGED of the tolerance, or adds no more than SHARE of it; otherwise the rates
are none, and the term that counts most is put back, until the rest may go; what was put back before that is tried
again. A scene that the full model does not meet decides nothing. With the choice every search is tried. Costs are of
this machine. Finished runs are kept, by what they depend on, in build/required_terms.json. `--store` puts every scene,
as it is done, into the file that comes with the package. `--recordings` makes scenes of the public recordings in the
folder that TORMAG_DATA names and measures these; `--wrong` measures two models that are wrong on purpose against what
the stored decisions predict of them. All devices are synthetic.
"""

import argparse
import shutil
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
from rendering.device_draws import SAMPLES
from rendering.scene_runs import ROOT, Case, costs, load_task, run, run_all
from rendering.signals import Signal, data_folder, recorded_signals

from tormagd.ctl.scene_new import new_scene
from tormagd.headroom.__main__ import build
from tormagd.headroom.machine_loop import machine_us
from tormagd.lab import executors
from tormagd.lab.arrays import Json
from tormagd.lab.told import lines
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
KEPT = ROOT / "build" / "required_terms.json"
STORED = ROOT / "tormagd" / "scenes" / FILE
FOLDER = ROOT / "build" / "recorded_scenes"
RECORDED = {
    "tool_torque": ("tool torque", False),
    "arterial_pressure": ("arterial pressure", True),
    "cataract": ("haptic scaled", True),
}
"Scenes of recordings: how the name of the signal begins, and whether it is played, and so known ahead."
HOLD = "brain"
PULSE = "pulse"
WRONG_S = 60.0
ALLOWED = 0.2
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

Runs = Callable[[Iterable[Case]], dict[Case, float]]


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
    terms = _alone(lambda out, mode: case(out, hz, samples[0], mode), scene.signal.is_known_ahead, runs)
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


def _alone(case: Callable[[Iterable[str], bool], Case], is_known_ahead: bool, runs: Runs) -> tuple[Without, ...]:
    """Each term left out alone. Without a preview in the setpoints nothing changes where it is not used."""
    tried = [term for term in TERMS if is_known_ahead or term != "preview"]
    found = runs([case(out, mode) for mode in MODES for out in [(), *((term,) for term in tried)]])
    terms = []
    for term in TERMS:
        frozen_N, learning_N = (
            found[case((term,), mode)] - found[case((), mode)] if term in tried else 0.0 for mode in MODES
        )
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


def wrong_models() -> Json:
    """What a wrong model costs a scene, as the stored decisions predict it and as it is: HOLD without any term misses
    more, predicted is the sum of what each term adds alone; PULSE with every term at the usual rates takes a multiple
    of the chosen model's time."""
    scenes = {scene.name: scene for scene in measured().scenes}
    hold, pulse = scenes[HOLD], scenes[PULSE]
    full_N, none_N = (run(Case(HOLD, SAMPLES[0], out, "", False, *hold.hz, WRONG_S)) for out in ((), TERMS))
    added_N, predicted_N = none_N - full_N, sum(item.frozen_added_N for item in hold.terms)
    priced = with_costs(pulse, PULSE)
    times, predicted = (each.cost_full_us_s / each.cost_us_s - 1.0 for each in (priced, pulse))
    return {
        HOLD: {"predicted_N": predicted_N, "measured_N": added_N, "off": abs(predicted_N / added_N - 1.0)},
        PULSE: {"predicted": predicted, "measured": times, "off": abs(predicted / times - 1.0)},
    }


def recorded(folder: Path) -> list[str]:
    """The files of the scenes that `tormagctl scene new` proposes for public recordings. Raises ConfigError where
    those are not there."""
    data = data_folder()
    signals = [] if data is None else recorded_signals(data)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    files = []
    for scene, (begins, is_known_ahead) in RECORDED.items():
        signal = next((each for each in signals if each.name.startswith(begins)), None)
        if signal is None:
            raise ConfigError("TORMAG_DATA: allowed is the folder of the recordings")
        files.append(str(written(folder / f"{scene}.toml", signal, is_known_ahead)))
    return files


def written(scene: Path, signal: Signal, is_known_ahead: bool) -> Path:
    """The scene file, as step 1 and 2 of docs/guides/scene.md make it. Raises CommandError where none is taken."""
    forces = scene.with_suffix(".csv")
    rows = np.column_stack([signal.time_s, signal.force_N])
    np.savetxt(forces, rows, fmt="%.6f", delimiter=",", header="t_s,force_N", comments="")
    new_scene(scene, forces, None)
    if is_known_ahead:
        text = scene.read_text(encoding="utf-8")
        scene.write_text(text.replace("[signal]\n", "[signal]\nis_known_ahead = true\n"), encoding="utf-8")
    return scene


def main(arguments: list[str] | None = None) -> int:
    """Measures the scenes that are named, or all that are shipped; 0, 1 where `--wrong` shows a prediction to be off
    by more than ALLOWED, or 2 for a scene that cannot be measured."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="name or file; default: every shipped one")
    parser.add_argument("--recordings", action="store_true", help="the scenes of recordings in TORMAG_DATA instead")
    parser.add_argument("--wrong", action="store_true", help="what wrong models cost, against what is predicted")
    parser.add_argument("--quick", action="store_true", help=f"sample 1 alone, and {QUICK_S:g} s: a look, no figure")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--store", action="store_true", help="write the file that comes with the package")
    executors.add_options(parser, 1, needed="tormagd, and tools/ on their path")
    options = parser.parse_args(arguments)
    seconds, longest_s, samples = (QUICK_S, QUICK_S, SAMPLES[:1]) if options.quick else (SECONDS, LONGEST_S, SAMPLES)
    found: list[MeasuredScene] = []
    try:
        names = recorded(FOLDER) if options.recordings else options.scenes or list(shipped_scenes())
        with executors.chosen(options) as executor:
            for name in [] if options.wrong else names:
                runs = partial(run_all, executor=executor, kept=KEPT)
                found.append(measure(name, runs, samples, seconds, longest_s))
                if options.store:
                    others = [scene for scene in measured().scenes if scene.name != found[-1].name]
                    every = sorted([*others, found[-1]], key=lambda scene: scene.name)
                    STORED.write_text(_text(_measured(every, seconds)), encoding="utf-8")
    except ConfigError as error:
        print(f"required_terms: {error}", file=sys.stderr)
        return 2
    if options.wrong:
        wrong = wrong_models()
        write_line(_text(wrong) if options.json else "\n".join(lines(wrong)), sys.stdout)
        return int(any(each["off"] > ALLOWED for each in wrong.values()))
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
