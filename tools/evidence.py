"""The long suites in full, their figures written under docs/evidence: what `make test` only samples.

Each part is a command that prints one JSON object and says by its exit status whether everything held. A part that
fails stops no other. Exit status 0 if all held.
"""

import argparse
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from tormagd import __version__

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "evidence"
README = "README.md"
HEADER = """# Evidence

Written by `make evidence`: the long suites in full, on simulated devices. Each file holds the command, the version and
the figures of its last run. *Measured* stands where a part judges nothing. `python tools/evidence.py NAME` repeats one.

| part | command | held | figures |
| --- | --- | --- | --- |
"""

Figures = dict[str, Any]


class Part(NamedTuple):
    """One long suite: its command behind `python`, its figures in a line, and whether its exit status judges them."""

    command: str
    says: Callable[[Figures], str]
    judges: bool = True


def main(arguments: list[str] | None = None) -> int:
    """Runs the named parts, or all; returns 0 if all held, 1 if not, 2 on a wrong command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("part", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; default all")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.part if name not in PARTS]
    if unknown:
        parser.error(f"{', '.join(unknown)}: allowed are {', '.join(PARTS)}")
    return collect({name: PARTS[name] for name in options.part or PARTS}, FOLDER)


def collect(parts: Mapping[str, Part], folder: Path) -> int:
    """Runs the parts one after the other and writes their files and the table of all files there are."""
    folder.mkdir(parents=True, exist_ok=True)
    failed = []
    for name, part in (progress := tqdm(parts.items(), desc="evidence", unit="part")):
        progress.set_description(name)
        record = run(part.command)
        text = json.dumps(record, indent=1, ensure_ascii=False) + "\n"
        (folder / f"{name}.json").write_text(text, encoding="utf-8")
        held = "held" if record["held"] else f"FAILED, {record['error'] or 'see its figures'}"
        tqdm.write(f"{name}: {held}", file=sys.stderr)
        if not record["held"]:
            failed.append(name)
    (folder / README).write_text(table(PARTS | dict(parts), folder), encoding="utf-8")
    if failed:
        print(f"did not hold: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def run(command: str) -> Figures:
    """What one part came to. Its progress goes to our stderr."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *shlex.split(command)], cwd=ROOT, stdout=subprocess.PIPE, env=environment, check=False
    )
    figures, error = None, ""
    try:
        figures = json.loads(done.stdout)
    except ValueError:
        error = f"no figures, exit status {done.returncode}"
    return {
        "command": f"python {command}",
        "version": __version__,
        "held": done.returncode == 0 and figures is not None and bool(figures.get("passed", True)),
        "error": error,
        "figures": figures,
    }


def table(parts: Mapping[str, Part], folder: Path) -> str:
    """The page that lists the parts whose files are there."""
    rows = []
    for name, part in parts.items():
        path = folder / f"{name}.json"
        if path.exists():
            record = json.loads(path.read_text(encoding="utf-8"))
            says = record["error"] if record["figures"] is None else _line(part, record["figures"])
            held = ("yes" if part.judges else "measured") if record["held"] else "**no**"
            rows.append(f"| [{name}]({path.name}) | `{record['command']}` | {held} | {says} |\n")
    return HEADER + "".join(rows)


def _line(part: Part, figures: Figures) -> str:
    try:
        return part.says(figures)
    except KeyError as error:
        return f"measured before this part had {error}: run it again"


def _says_fuzz(figures: Figures) -> str:
    clean, rise_N = figures["clean"], figures["harm"]["one_false_accept"]["greatest_rise_N"]
    chance = sum(kind["judged"] * kind["odds"] for kind in figures["kinds"].values())
    return (
        f"{figures['frames']:,} damaged serial and {figures['can_frames']:,} CAN frames: {figures['false_accepts']} "
        f"false accepts where the CRCs' odds give up to {chance:.0f}; one lifts the force by {rise_N} N at most; "
        f"{clean['second_lost']} of {clean['runs_of_damage']:,} runs of damage not over after two frames; "
        f"C and Python differ {figures['languages_differ']} times"
    )


def _says_bus(figures: Figures) -> str:
    loads = ", ".join(f"{name} {way['headroom']:.0%}" for name, way in figures["ways"].items())
    return f"headroom at 1 kHz and 1 Mbit/s: {loads}; codec {figures['codec_us']['payloads_best']:.1f} us a cycle"


def _says_faults(figures: Figures) -> str:
    cells = figures["cells"]
    verdicts = ("named", "safe", "in_time", "recovered")
    named, safe, in_time, recovered = (sum(cell[name] for cell in cells) for name in verdicts)
    opens = [cell["open_ms"] for cell in cells if cell["expected"] == "opens" and cell["open_ms"] is not None]
    return (
        f"{len(cells)} cells on serial and CAN: {named} named, {safe} ended safe, {in_time} reacted in their "
        f"stated time, {recovered} recovered as documented; what is to open is open after at "
        f"most {max(opens):g} ms; no force is lost faster than by {max(cell['loss_N_s'] for cell in cells)} N/s"
    )


def _says_planted(figures: Figures) -> str:
    return f"{figures['caught']} of {figures['planted']} faults planted in safety, step, governor and link are caught"


def _says_walk(figures: Figures) -> str:
    return (
        f"{figures['steps']:,} steps, {figures['driven']:,} of them driven, {len(figures['faults'])} kinds of faults: "
        f"{figures['broken'] or 'no duty over its limit, nothing driven while disabled, no way beside the table'}"
    )


def _says_numerics(figures: Figures) -> str:
    worst = ", ".join(f"{name} {error:.1e}" for name, error in figures["worst_rel_error"].items())
    return f"{figures['cases']:,} cases, {figures['reference_cases']:,} references; worst relative error {worst}"


def _says_soak(figures: Figures) -> str:
    virtual, daemon = figures["virtual"], figures["daemon"]
    recorded = daemon["recording"]
    return (
        f"{virtual['minutes']:g} min virtual, {virtual['growth_kB']:+} kB; {daemon['minutes']:g} min daemon, "
        f"{daemon['growth_kB']:+} kB, {daemon['descriptor_growth']:+} descriptors, {daemon['clients']} clients; "
        f"{recorded['ticks']:,} ticks recorded, {recorded['ticks_out_of_sequence']} out of sequence"
    )


def _says_replug(figures: Figures) -> str:
    lost_ms = max(spread["max"] for spread in figures["lost_after_ms"].values())
    running_ms, descriptors = figures["running_after_ms"], figures["descriptors"]
    return (
        f"{figures['cycles']} cycles, {figures['losses']} losses; host knows after {lost_ms} ms at most; running again "
        f"{running_ms['p50']} ms after the device's return (median), {running_ms['max']} ms at most; armed by itself "
        f"{figures['rearmed']} times; descriptors {descriptors['first']}, at the end {descriptors['last']}"
    )


def _says_envelope(figures: Figures) -> str:
    """What is rendered at the corners, in a line."""
    return (
        f"{figures['cases']} runs on samples and {figures['draws']} draws: over what was asked by "
        f"{figures['over_N'] * 1e3:.0f} mN at most ({figures['over_sample_1_N'] * 1e3:.0f} on sample 1), at most "
        f"{figures['peak_N']:.2f} N at all, {figures['settled_N'] * 1e3:.0f} mN off after 2 s of sliding, "
        f"{figures['low_hold_faults']} faults below F_min"
    )


def _says_stalls(figures: Figures) -> str:
    short = [row for row in figures["rows"] if row["asked_ms"] < 50.0]
    stops, faulted = (sum(row[name] for row in short) for name in ("stops", "faulted"))
    return (
        f"{figures['stops']} stops of daemon and device; {faulted} of {stops} for 5 to 45 ms latched, force off by "
        f"{max(row['worst_N'] for row in short)} N at most; {len(figures['failures'])} did not hold"
    )


def _says_intruders(figures: Figures) -> str:
    (line,) = figures["lines"].values()
    host = line["host"]
    kept = f"meanwhile a bare timer kept {host['bare_kept']:.1%}, stood still for up to {host['bare_worst_ms']:.0f} ms"
    return f"{line['says']}; {kept}"


def _says_wrong_model(figures: Figures) -> str:
    hold, pulse = figures["cheapest"], figures["fullest"]
    return (
        f"`{hold['scene']}` without any term misses {1e3 * hold['measured_N']:.1f} mN more, "
        f"{1e3 * hold['predicted_N']:.1f} predicted; `{pulse['scene']}` with every term at the usual rates takes "
        f"{pulse['measured']:.2f} times the chosen model's time more, {pulse['predicted']:.2f} predicted"
    )


def _says_unmet(figures: Figures) -> str:
    rows = "; ".join(
        f"{name} {', '.join(f'{1e3 * error_N:.1f}' for error_N in errors_N.values())}"
        for name, errors_N in figures["rms_N"].items()
    )
    return f"`{figures['scene']}`, tolerance {1e3 * figures['tolerance_N']:g} mN, RMS on samples 1 to 3, mN: {rows}"


def _says_recordings(figures: Figures) -> str:
    scenes = []
    for scene in figures["scenes"]:
        inside = ", ".join(item["term"] for item in scene["terms"] if item["term"] not in scene["left_out"])
        within = max(item["chosen_N"] for item in scene["judged"]) / scene["tolerance_N"]
        scenes.append(f"`{scene['name']}` requires {inside}: {within:.2f} of its tolerance at the worst")
    return "; ".join(scenes)


def _says_motor(figures: Figures) -> str:
    rows = [found for samples in figures["added_N"].values() for found in samples.values()]
    most = ", ".join(f"{name} {1e3 * max(found[name] for found in rows):.1f}" for name in rows[0])
    return f"most that the absence of each adds on samples 1 to 3, mN: {most}"


def _says_rates(figures: Figures) -> str:
    worst_N = max(max(row) for row in figures["error_N"].values())
    rows = "; ".join(f"{swings} {1e3 * missed['nothing']:.1f}" for swings, missed in figures["frozen_N"].items())
    return f"the model says up to {1e3 * worst_N:.0f} mN too much; `{figures['scene']}` frozen misses, mN: {rows}"


def _says_inverse(figures: Figures) -> str:
    beaten = ", ".join(figures["beaten"]) or "nowhere"
    return (
        f"{len(figures['variants'])} variants of the search for the field; the daemon's is "
        f"{figures['speedup_vs_thesis_linear']:.0f} times faster than the thesis's; beaten {beaten}"
    )


def _says_tracking(figures: Figures) -> str:
    pulses: dict[bool, list[str]] = {False: [], True: []}
    for row in figures["samples"]["rows"]:
        pulses[row["preview"]].append(f"{1e3 * row['after_trim']['rms_N']:.1f}")
    draws = ", ".join(f"{1e3 * found['worst_rms_N']:.1f}" for found in figures["draws"])
    return (
        f"the pulse after 10 s on samples 1 to 3, RMS in mN: {', '.join(pulses[False])} live, "
        f"{', '.join(pulses[True])} with preview; worst of {figures['draws'][0]['count']} draws with preview and "
        f"live: {draws}; staircase off by {1e3 * max(row['worst_N'] for row in figures['staircase']['rows']):.0f} mN "
        "at most"
    )


def _says_step(figures: Figures) -> str:
    return (
        f"1 mm: rise {figures['rise_s'] * 1e3:.0f} ms, {figures['rise_over_time_optimal']:.2f} times the fastest, "
        f"overshoot {figures['overshoot']:.1%}, settled after {figures['settling_5pct_s'] * 1e3:.0f} ms; H(z) off by "
        f"{figures['model_nrmse']:.1%} NRMSE"
    )


def _says_pad_hold(figures: Figures) -> str:
    worst = (
        f"{held['plant']} {'with' if held['relaxation'] else 'without'} relaxation {held['force_error']:.2%}"
        for held in figures["holds"]
        if not held["is_learning"]
    )
    return f"an hour at {figures['force_N']:g} N, frozen, greatest error of the force: {', '.join(worst)}"


PARTS = {
    "fuzz": Part("tools/fuzz_protocol.py --json", _says_fuzz),
    "bus": Part("tools/benchmark.py bus --json", _says_bus),
    "faults": Part("tools/faults.py --json", _says_faults),
    "planted": Part("tools/planted_faults.py --json", _says_planted),
    "walk": Part("tools/random_walk.py --json", _says_walk),
    "numerics": Part("tools/numerics.py --json", _says_numerics),
    "replug_serial": Part("tools/replug.py --cycles 200 --transport serial --json", _says_replug),
    "replug_can": Part("tools/replug.py --cycles 200 --transport can --json", _says_replug),
    "soak": Part("tools/soak.py --minutes 30 --json", _says_soak),
    "stalls": Part("tools/stalls.py --json", _says_stalls),
    "strangers": Part("tools/intruders.py strangers --json", _says_intruders),
    "pulse": Part("tools/intruders.py pulse --json", _says_intruders),
    "stop": Part("tools/intruders.py stop --json", _says_intruders),
    "floods": Part("tools/intruders.py floods --json", _says_intruders),
    "messages": Part("tools/intruders.py messages --json", _says_intruders),
    "inverse": Part("tools/benchmark.py inverse --json --write", _says_inverse, judges=False),
    "wrong_model": Part("tools/wrong_model.py --json", _says_wrong_model),
    "unmet": Part("tools/unmet_scene.py --json", _says_unmet, judges=False),
    "recordings": Part("tools/recorded_scenes.py --json", _says_recordings, judges=False),
    "motor": Part("tools/motor_parts.py --json", _says_motor, judges=False),
    "rates": Part("tools/rate_error.py --json", _says_rates, judges=False),
    "envelope": Part("tools/envelope.py --json --picture docs/images/envelope.png", _says_envelope),
    "step": Part("tools/benchmark.py step --json --plot docs/images/step.png", _says_step, judges=False),
    "tracking": Part(
        "tools/force_tracking.py samples draws staircase --json --picture docs/images/force_tracking.png",
        _says_tracking,
        judges=False,
    ),
    "pad_hold": Part(
        "-m tormagd.lab tactile-hold --coarse --json --picture docs/images/tactile_hold_1h.png",
        _says_pad_hold,
        judges=False,
    ),
}


if __name__ == "__main__":
    sys.exit(main())
