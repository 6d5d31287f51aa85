"""The pictures of `make run`."""

from pathlib import Path

from judge.following import Followed, Rehearsals, tracking
from judge.touching import Touch

from demo.live_touch import (
    FELT_N,
    HALF_S,
    PUSH_MM_S,
    ROUND_TRIP_MS,
    TOUCHES,
    WALL_N_MM,
    bounds,
    figures as touch_figures,
    lateness,
)
from demo.show import PULSE_START_S, Shown
from tormag_lab.arrays import Array
from tormag_lab.pages import stamp, subplots
from tormagd.scenes.scene import Scene
from tormagd.view.drawing import Axes

ASKED, RENDERED, OTHER, QUIET = "#222222", "#d1495b", "#2a6f97", "#8d99ae"
CLOSE_UP_S = 4.0


def show_picture(path: Path, scene: Scene, shown: Shown, rehearsals: Rehearsals, figures: list[str]) -> None:
    time_s, asked_N, rendered_N = shown.time_s, shown.asked_N, shown.rendered_N
    figure, axes = subplots((13.0, 10.5), 3, 2)
    figure.suptitle("A measured human pulse, rendered as friction force by the simulated device", fontsize=14)
    _forces(axes[0, 0], time_s, asked_N, rendered_N, "Real time, plant sample 1")
    axes[0, 0].axvspan(0.0, PULSE_START_S, color="#eef0f4", zorder=0)
    axes[0, 0].text(PULSE_START_S / 2, axes[0, 0].get_ylim()[0] + 0.03, "approach", ha="center", color=QUIET)
    middle = PULSE_START_S + 6.0
    near = (time_s >= middle) & (time_s < middle + CLOSE_UP_S)
    _forces(axes[0, 1], time_s[near], asked_N[near], rendered_N[near], "Close-up")
    _error(axes[1, 0], scene, shown)
    axes[1, 1].plot(time_s[near], shown.gap_mm[near], color=OTHER)
    _dress(axes[1, 1], "Gap between the magnets (close-up)", "gap, mm")
    _samples(axes[2, 0], rehearsals)
    _reversals(axes[2, 1], next(found for case, found in rehearsals.items() if case.hand != "steady"))
    figure.savefig(path, dpi=110, metadata=stamp(figures))


def touch_picture(path: Path, touched: list[Touch], figures: list[str]) -> None:
    figure, axes = subplots((13.0, 5.2), 1, len(TOUCHES), sharey=True)
    figure.suptitle(
        f"A hand meets a wall of {WALL_N_MM:g} N/mm at {PUSH_MM_S:g} mm/s, over a round trip of {ROUND_TRIP_MS:g} ms",
        fontsize=14,
    )
    for each, name, run, bound in zip(axes, TOUCHES, touched, bounds(), strict=True):
        _touch(each, name, run, bound)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(path, dpi=110, metadata=stamp(figures))


def _touch(axes: Axes, name: str, run: Touch, bound: Touch) -> None:
    time_s, bound_s = (each.time_s - each.time_s[(each.depth_mm > 0.0).argmax()] for each in (run, bound))
    turn_s, end_s = float(time_s[0]) + HALF_S, float(time_s[-1])
    axes.axvspan(turn_s, end_s, color="#eef0f4", zorder=0)
    axes.text(turn_s, 0.02, " the hand draws back", color=QUIET, transform=axes.get_xaxis_transform())
    axes.plot(time_s, run.force_N, color=QUIET, linewidth=1.0, label="on the handle (negative: resists the way back)")
    axes.plot(bound_s, bound.kinetic_N, color=OTHER, linewidth=1.2, linestyle="--", label="felt by ideal carriages")
    axes.plot(time_s, run.kinetic_N, color=RENDERED, linewidth=1.6, label="felt while the handle slides")
    wall_N = WALL_N_MM * run.depth_mm.clip(0.0)
    axes.plot(time_s, wall_N, color=ASKED, linewidth=1.4, label="the wall's, at the handle's place")
    axes.set_xlim(float(time_s[0]), end_s)
    told = touch_figures(run, bound)
    late, least = (lateness(told[key]) for key in ("felt_later_ms", "bound_later_ms"))
    title = f"{name.capitalize()}: {FELT_N:g} N felt {late}\n(by ideal carriages {least})"
    _dress(axes, title, "force, N", "time since the handle met the wall, s")


def _forces(
    axes: Axes, time_s: Array, asked_N: Array, rendered_N: Array, title: str, label: str = "rendered (the plant's)"
) -> None:
    axes.plot(time_s, asked_N, color=ASKED, linewidth=1.4, label="asked")
    axes.plot(time_s, rendered_N, color=RENDERED, linewidth=1.2, label=label)
    # where it covers nothing
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False, borderaxespad=0.0)
    _dress(axes, title, "force at the roller, N")


def _error(axes: Axes, scene: Scene, shown: Shown) -> None:
    pulse = shown.time_s >= PULSE_START_S
    result = tracking(shown.asked_N[pulse], shown.rendered_N[pulse])
    axes.axhline(0.0, color=QUIET, linewidth=0.8)
    axes.plot(shown.time_s[pulse], (shown.rendered_N - shown.asked_N)[pulse] * 1e3, color=RENDERED, linewidth=0.9)
    title = (
        f"Error: RMS {result.rms_N * 1e3:.1f} mN (the scene allows {scene.force.tolerance_rms_N * 1e3:g}), "
        f"variance accounted for {result.variance_accounted_for:.3f}"
    )
    _dress(axes, title, "rendered - asked, mN")


def _samples(axes: Axes, rehearsals: Rehearsals) -> None:
    steady = {case: found.since(PULSE_START_S) for case, found in rehearsals.items() if case.hand == "steady"}
    results = list(steady.values())
    names = [case.label.replace(", ", ",\n") for case in steady]
    bars = axes.bar(names, [result.rms_N * 1e3 for result in results], color=OTHER, width=0.6)
    deviation_mN = results[0].reference_sd_N * 1e3
    axes.axhline(deviation_mN, color=QUIET, linestyle="--")
    axes.text(-0.4, deviation_mN, "the pulse's own standard deviation", color=QUIET, va="bottom", fontsize=9)
    labels = [f"{result.rms_N * 1e3:.1f} mN\nVAF {result.variance_accounted_for:.2f}" for result in results]
    axes.bar_label(bars, labels, padding=2, fontsize=9)
    axes.margins(y=0.25)
    _dress(axes, "RMS error in virtual time: other samples, and the thesis's gap speed", "RMS error, mN", "")


def _reversals(axes: Axes, moving: Followed) -> None:
    part = (moving.time_s >= PULSE_START_S + 4.0) & (moving.time_s < PULSE_START_S + 12.0)
    time_s, title = moving.time_s[part], "A handle that stops and reverses"
    _forces(axes, time_s, moving.asked_N[part], moving.rendered_N[part], title, "felt (signed)")
    second = axes.twinx()
    second.fill_between(time_s, moving.handle_mm_s[part], color=QUIET, alpha=0.25, linewidth=0)
    second.set_ylabel("handle speed, mm/s (grey)", color=QUIET)


def _dress(axes: Axes, title: str, quantity: str, horizontal: str = "time, s") -> None:
    axes.set_title(title, loc="left", fontsize=10.5)
    axes.set(xlabel=horizontal, ylabel=quantity)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", alpha=0.25)
