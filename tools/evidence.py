"""Runs the long suites in full, of which `make test` only samples, and writes their figures to docs/evidence/README.md.

Each part is a command that prints one JSON object and says by its exit status whether everything held. A failing part
does not stop the others. Exit status 0 if all held.
"""

import argparse
import datetime
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from tormagd import __version__

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "evidence"
README = "README.md"
HEADER = """# Evidence

`make evidence` measures this on simulated devices; `python tools/evidence.py NAME` repeats a part. *Measured* parts
have no verdict.

| part | command | version, day | held | figures |
| --- | --- | --- | --- | --- |
"""


class Part(NamedTuple):
    """One long suite: its command behind `python`, how its figures read in a line, and whether its exit status judges
    them. Figures that a page is made of are kept as NAME.json.
    """

    command: str
    says: str
    judges: bool = True
    is_kept: bool = False


PARTS = {
    "fuzz": Part(
        "tools/judge.py endure fuzz --json",
        "{executions[codec]:,} payloads, {executions[framing]:,} streams and {executions[device]:,} lives "
        "under sanitizers. C and Python differ {languages_differ} times",
    ),
    "replug-serial": Part(
        "tools/judge.py endure replug-serial --json", "{cycles} cycles. Lost after {lost_after_ms} ms at most"
    ),
    "replug-can": Part(
        "tools/judge.py endure replug-can --json", "{cycles} cycles; lost after {lost_after_ms} ms at most"
    ),
    "soak": Part(
        "tools/judge.py endure soak --json", "{minutes} min, growth in kB {growth_kB}, {ticks:,} ticks recorded"
    ),
    "faults": Part("tools/judge.py faults --json", "all cells: [the matrix](../fault-matrix.md)", is_kept=True),
    "numerics": Part(
        "tools/judge.py numerics --json",
        "{cases:,} cases, {stage_cases:,} hostile steps of the core's stages: [errors](../measurements.md)",
    ),
    "inverse": Part(
        "tools/benchmark.py inverse --json",
        "the daemon's search is {speedup_vs_thesis_linear:.0f} times as fast as the thesis's: "
        "[the trade](../inverse_trade.md)",
        judges=False,
    ),
    "envelope": Part(
        "tools/judge.py envelope --json --picture docs/images/envelope.png",
        "{cases} runs on samples and {draws} draws: [bounds and worst](../control.md#the-envelope)",
    ),
    "models": Part(
        "tools/judge.py models --json",
        "[every insert's model on devices](../guides/insert.md#the-shipped-models)",
        is_kept=True,
    ),
    "step": Part(
        "tools/benchmark.py step --json",
        "1 mm: rise {rise_s:.3f} s, {rise_over_time_optimal:.2f} times the fastest, overshoot {overshoot:.1%}, settled "
        "after {settling_5pct_s:.3f} s; H(z) off by {model_nrmse:.1%} NRMSE",
        judges=False,
    ),
    "tracking": Part(
        "tools/judge.py tracking pulse --json",
        "the pulse on samples 1 to 3, live, RMS: {pulse[sample_1][live]:.4f}, {pulse[sample_2][live]:.4f}, "
        "{pulse[sample_3][live]:.4f} N",
        judges=False,
    ),
}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("part", nargs="*", choices=PARTS, metavar="PART", help=f"of {', '.join(PARTS)}; default all")
    return collect({name: PARTS[name] for name in parser.parse_args(arguments).part or PARTS}, FOLDER)


def collect(parts: Mapping[str, Part], folder: Path) -> int:
    """Run the parts in order and write their lines into the folder's table."""
    page = folder / README
    rows = {line.split(" | ")[0]: line for line in page.read_text(encoding="utf-8").splitlines() if " | `" in line}
    failed = []
    for name, part in (progress := tqdm(parts.items(), desc="evidence", unit="part")):
        progress.set_description(name)
        held, says = run(name, part, folder)
        day = f"{__version__}, {datetime.date.today()}"
        rows[f"| {name}"] = f"| {name} | `python {part.command}` | {day} | {held} | {says} |"
        if held == "**no**":
            failed.append(name)
        page.write_text(HEADER + "".join(f"{row}\n" for row in rows.values()), encoding="utf-8")
    if failed:
        print(f"did not hold: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def run(name: str, part: Part, folder: Path) -> tuple[str, str]:
    command, environment = [sys.executable, *shlex.split(part.command)], os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, env=environment, check=False)
    try:
        figures = json.loads(done.stdout)
    except ValueError:
        return "**no**", f"no figures, exit status {done.returncode}"
    if part.is_kept:
        record = {"command": f"python {part.command}", "version": __version__, "figures": figures}
        (folder / f"{name}.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    holds = done.returncode == 0 and figures.get("passed", True)
    return ("yes" if part.judges else "measured") if holds else "**no**", part.says.format_map(figures)


if __name__ == "__main__":
    sys.exit(main())
