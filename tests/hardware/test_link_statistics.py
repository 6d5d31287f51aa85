"""The link in figures: round trip and device clock against known ones, and how well the wire carries."""

import itertools
import random
from collections import defaultdict
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import pytest
from hypothesis import example, given, settings, strategies as st

from tormagd.hardware.link_statistics import (
    LOOKED_S,
    LOOKS,
    LOSES,
    MIN_WINDOWS,
    ROUND_TRIPS,
    SETTLING_LOOKS,
    STANDING,
    WINDOW_S,
    WINDOWS,
    DeviceClock,
    LinkQuality,
    LinkWatch,
    RoundTrip,
)
from tormagd_client.messages import RoundTripReport

PERIOD_S = 1e-3


def exchange(
    trip: RoundTrip, ticks: Iterable[int], way_ticks: int, lost: frozenset[int] = frozenset(), paused: range = range(0)
) -> None:
    """Answer each Drive that is not lost `way_ticks` later, or right after a pause."""
    states = itertools.count(1)
    answers: defaultdict[int, list[Callable[[], None]]] = defaultdict(list)
    for tick in ticks:
        for answer in answers.pop(tick, ()):
            answer()
        trip.drive(tick % 256, tick * PERIOD_S)
        answered = paused.stop if tick + way_ticks in paused else tick + way_ticks
        if tick not in lost:
            answers[answered].append(partial(trip.state, next(states) % 256, answered * PERIOD_S))
        if tick % 20 == 0 and tick not in lost:
            answers[answered].append(partial(trip.status, tick % 256))
        if tick % 1_000 == 0:
            trip.hello()
            answers[answered].append(trip.identity)


@pytest.fixture
def trip() -> RoundTrip:
    return RoundTrip()


@pytest.mark.parametrize(
    ("way_ticks", "ticks", "lost"),
    [
        # a USB adapter that holds bytes back for 16 ms has 16 Drives under way at a time
        *((way_ticks, 1_400, ()) for way_ticks in (1, 2, 16, 120)),
        # the next Hello makes it good
        (3, 2_400, (1_500, 1_501)),
        # one lost Drive makes all of them a period too long; the second shows in the Status of tick 1320
        (3, 1_324, (1_010, 1_300)),
    ],
)
def test_a_round_trip_of_any_length_is_known_after_one_hello_or_a_status_that_contradicts_it(
    way_ticks: int, ticks: int, lost: tuple[int, ...], trip: RoundTrip
) -> None:
    assert trip.report() is None
    exchange(trip, range(1, ticks), way_ticks, frozenset(lost))
    assert trip.report() == RoundTripReport(*[way_ticks * 1e3] * 3)
    assert (trip.least_s, trip.usual_s) == pytest.approx((way_ticks * PERIOD_S, way_ticks * PERIOD_S))


def test_percentiles_are_of_all_round_trips(trip: RoundTrip) -> None:
    for counter in range(1, 102):
        trip.drive(counter, 0.0)
    for counter in range(1, 102):
        trip.state(counter, counter * PERIOD_S)
        trip.status(counter)
    assert (trip.report(), trip.usual_s) == (RoundTripReport(1e3, 51e3, 100e3), pytest.approx(0.051))


def test_an_answer_to_what_has_not_been_sent_ends_the_count(trip: RoundTrip) -> None:
    exchange(trip, range(1, 1_400), 1)
    trip.drive(10, 5.0)
    trip.state(200, 5.0)
    known = trip.report()
    trip.state(201, 5.001)
    assert trip.report() == known


def test_a_state_that_overtakes_the_status_of_the_drive_before_contradicts_nothing(trip: RoundTrip) -> None:
    exchange(trip, range(1, 256), 1)
    known = trip.report()
    trip.state(255, 0.256)
    trip.drive(0, 0.256)
    trip.state(0, 0.257)
    trip.status(255)
    assert trip.report() == known == RoundTripReport(1e3, 1e3, 1e3)


def test_a_status_tells_no_round_trip_of_a_drive_that_was_not_sent_or_is_not_answered_yet(trip: RoundTrip) -> None:
    trip.drive(10, 5.0)
    trip.state(1, 5.001)
    for counter in (100, 200):  # as if it came before and after what was sent
        trip.status(counter)
        assert (trip.report(), trip.since_next_s(counter, 5.001)) == (None, 0.0)
    trip.drive(11, 5.002)
    trip.status(11)
    assert trip.report() is None


def heard(device_s: Callable[[float], float], ticks: int) -> DeviceClock:
    clock = DeviceClock()
    for tick in range(ticks):
        clock.add(tick * PERIOD_S, device_s(tick * PERIOD_S))
    return clock


@settings(max_examples=25, deadline=None)
@example(drift_ppm=0.638671875, offset_s=-180.0, seed=198, outlier_share=0.0)  # one step of the clock in all that time
@given(
    drift_ppm=st.floats(-300.0, 300.0),
    offset_s=st.floats(-1e5, 1e5),
    seed=st.integers(0, 1_000),
    outlier_share=st.floats(0.0, 0.1),
)
def test_offset_and_drift_are_found_behind_jitter_and_outliers(
    drift_ppm: float, offset_s: float, seed: int, outlier_share: float
) -> None:
    noise = random.Random(seed)
    clock = DeviceClock()
    late_until_s = late_s = 0.0
    for tick in range(0, 20_000, 5):
        now_s = tick * PERIOD_S
        if now_s >= late_until_s:
            late_until_s = now_s + WINDOW_S
            late_s = noise.uniform(0.005, 0.05) if noise.random() < outlier_share else 0.0
        latched_s = now_s - noise.uniform(0.0002, 0.0004) - late_s
        clock.add(now_s, round((latched_s - offset_s) * (1.0 + drift_ppm * 1e-6), 5))
    fit = clock.fit()
    device_s = (20.0 - offset_s) * (1.0 + drift_ppm * 1e-6)
    assert (fit.windows, fit.drift_ppm, fit.offset_s) == (
        39,
        pytest.approx(drift_ppm, abs=2.0),
        pytest.approx(20.0 - device_s, abs=2.5e-4 + abs(drift_ppm) * 1e-6),
    )
    assert fit.residual_us < 20.0


def test_memory_is_bounded_and_the_fit_follows_the_last_half_minute() -> None:
    clock, trip = DeviceClock(), RoundTrip()
    exchange(trip, range(1, 2_000), 1)
    device_s = 0.0
    for tick in range(600 * 20):
        device_s += 0.05 * (1.0 + (100e-6 if tick < 300 * 20 else -50e-6))
        clock.add(tick * 0.05, device_s)
    fit = clock.fit()
    assert (fit.windows, fit.drift_ppm) == (WINDOWS, pytest.approx(-50.0, abs=0.1))
    assert (len(clock._windows), len(trip._recent)) == (WINDOWS, ROUND_TRIPS)


@pytest.mark.parametrize(("windows", "is_known"), [(MIN_WINDOWS - 1, False), (MIN_WINDOWS, True)])
def test_nothing_is_claimed_before_there_is_enough(windows: int, is_known: bool) -> None:
    clock = heard(lambda now_s: now_s, 1 + round(windows * WINDOW_S / PERIOD_S))
    assert (clock.fit() is not None, clock.drift) == (is_known, 0.0)


@pytest.mark.parametrize(("late_s", "outliers"), [(4e-4, 0), (8e-4, 1)])
def test_a_window_further_off_than_the_jitter_explains_does_not_count(late_s: float, outliers: int) -> None:
    clock = DeviceClock()
    for window in range(31):
        clock.add(window * WINDOW_S, window * WINDOW_S - 1e-4 * (window % 3) - late_s * (window == 15))
    assert (clock.fit().windows, clock.fit().outliers) == (30, outliers)


@pytest.mark.parametrize("step_s", [-5.0, -0.1, 0.1])
@pytest.mark.parametrize("after_s", [5.0, 8.0, 15.0, 25.0])
def test_a_clock_that_is_set_begins_a_new_line(step_s: float, after_s: float) -> None:
    fit = heard(lambda now_s: now_s * (1.0 + 30e-6) + step_s * (now_s > 30.0 - after_s), 30_000).fit()
    assert (fit.drift_ppm, fit.offset_s) == (
        pytest.approx(30.0, abs=1.0),
        pytest.approx(-30.0 * 30e-6 - step_s, abs=1e-4),
    )


NOISE = random.Random(1)
NOW_AND_THEN = frozenset(tick for tick in range(1, 20_000) if NOISE.random() < 0.05)
UNANSWERED = {every: frozenset(tick for tick in range(1, 4_000) if tick % every) for every in (2, 3)}
"""The States fall behind the Drives by hundreds a second."""


@pytest.mark.parametrize(
    ("way_ticks", "ticks", "lost", "least_us", "most_us", "within_s"),
    [
        *((way, 4_000, lost, 0.0, way * 1e3 + 1.0, 1e-6) for way in (1, 5, 15) for lost in UNANSWERED.values()),
        # one lost Drive alone looks like an answer that is on its way
        *((way, 20_000, NOW_AND_THEN, (way - 1) * 1e3, (way + 2) * 1e3, 1.5 * PERIOD_S) for way in (1, 15)),
    ],
)
def test_drives_that_are_not_answered_make_no_round_trip_long(
    way_ticks: int, ticks: int, lost: frozenset[int], least_us: float, most_us: float, within_s: float, trip: RoundTrip
) -> None:
    exchange(trip, range(1, ticks), way_ticks, lost=lost)
    report = trip.report()
    assert least_us <= report.least <= report.p99 <= most_us
    assert trip.usual_s == pytest.approx(way_ticks * PERIOD_S, abs=within_s)


@pytest.mark.parametrize("after_ticks", [1, 20, 40, 70, 150])
def test_a_device_that_stood_still_for_its_timeout_has_the_round_trip_that_it_had(
    after_ticks: int, trip: RoundTrip
) -> None:
    paused = range(2_010, 2_058)
    exchange(trip, range(1, paused.stop + after_ticks), 1, paused=paused)
    assert trip.usual_s == pytest.approx(PERIOD_S)


@pytest.mark.parametrize("drift", [-0.5, -0.02, 3e-5, 0.015, 0.3])
def test_a_clock_that_runs_wrong_is_known_within_four_seconds(drift: float) -> None:
    assert heard(lambda now_s: round(now_s * (1.0 + drift), 5), 4_100).drift == pytest.approx(drift, rel=0.02, abs=2e-5)


@pytest.mark.parametrize("delay_s", [0.005, 0.03, 0.1])
def test_a_delay_that_begins_is_no_drift(delay_s: float) -> None:
    clock = DeviceClock()
    for tick in range(15_000):
        now_s = tick * PERIOD_S
        clock.add(now_s, now_s - (delay_s if tick > 6_000 else 0.0))
        assert abs(clock.drift) < 0.01


def test_a_clock_that_stands_is_known_at_once_and_forgiven_when_it_goes() -> None:
    clock = heard(lambda now_s: now_s, 1_000)
    drifts = []
    for tick in range(STANDING + 2):
        clock.add((1_000 + tick) * PERIOD_S, float("1.0"))  # equal, and not the same
        drifts.append(clock.drift)
    assert drifts == [0.0] * (STANDING + 1) + [-1.0]
    for tick in range(10_000):
        clock.add((1_030 + tick) * PERIOD_S, 1.0 + tick * PERIOD_S)
    assert abs(clock.drift) < 1e-4


GOOD = {"drives": 100, "states": 100, "frames": 205, "damaged": 0, "unsent": 0}


def watched(looks: list[dict[str, int]]) -> LinkQuality:
    watch, now_s, quality = LinkWatch(0.0), 0.0, LinkQuality()
    total: Any = (0, 0, 0, 0, 0)
    for step in looks:
        total = tuple(map(sum, zip(total, step.values(), strict=True)))
        while not watch.is_due(now_s):
            now_s += 1e-3
        quality = watch.look(now_s, total, 7e-4, 2e-5)
    return quality


def test_nothing_is_said_before_the_first_answers_have_come() -> None:
    watch = LinkWatch(5.0)
    assert not watch.is_due(5.0 + (SETTLING_LOOKS - 0.1) * LOOKED_S)
    assert watch.is_due(5.0 + (SETTLING_LOOKS + 0.1) * LOOKED_S)
    assert watch.look(5.3, (3, 0, 0, 0, 0), 0.0, 0.0) == LinkQuality(), "one look alone is no second"


@pytest.mark.parametrize(
    ("change", "name", "share"),
    [
        ({"states": 95}, "unanswered", 0.05),
        ({"damaged": 205}, "damaged", 0.5),
        ({"unsent": 30}, "unsent", 0.3),
        ({"states": 0, "frames": 0}, "unanswered", 1.0),
    ],
)
def test_each_share_is_of_its_own_and_forgotten_after_a_second(change, name: str, share: float) -> None:
    bad = GOOD | change
    quality = watched([GOOD] * 3 + [bad] * 11)
    assert (getattr(quality, name), quality.is_lossy) == (pytest.approx(share), True)
    assert share > LOSES
    # the shares of one bad look among the ten of a second
    assert getattr(watched([GOOD] * 12 + [bad]), name) <= share / LOOKS * 2.0
    in_order = watched([bad] * 12 + [GOOD] * LOOKS)
    assert (in_order, in_order.is_lossy) == (LinkQuality(0.0, 0.0, 0.0, 7e-4, 2e-5), False)


def test_a_round_trip_is_long_once_two_looks_have_found_it_so() -> None:
    watch = LinkWatch(0.0)
    counts = (100, 100, 205, 0, 0)
    found = [watch.look(0.1 * look, counts, trip_s, 0.0).round_trip_s for look, trip_s in enumerate((1e-3, 2e-2, 1e-3))]
    assert found[1:] == [1e-3, 1e-3]
    assert [watch.look(1.0, counts, 2e-2, 0.0).round_trip_s for _ in range(2)] == [1e-3, 2e-2]


def test_it_says_its_figures() -> None:
    assert str(LinkQuality(0.05, 0.021, 0.3, 0.0152, 0.0)) == (
        "5.0% of the Drives were not answered, 2.1% of the frames came damaged, 30.0% were not taken by the wire, "
        "the round trip is 15.2 ms"
    )
