import numpy as np
import pytest
from hypothesis import given, strategies as st
from msgspec.structs import astuple

from tormagd.daemon.rate_group import ERROR_PERIODS, HORIZON_NS, SHARES, Histogram, RateGroup

PERIOD_NS = 1_000_000


def recorded(lateness_us: list[float]) -> RateGroup:
    group = RateGroup("test", PERIOD_NS)
    for number, late in enumerate(lateness_us):
        due = number * PERIOD_NS
        start = due + round(late * 1e3)
        group.record(due, start, start + 10_000)
    return group


@pytest.fixture
def group() -> RateGroup:
    return RateGroup("test", PERIOD_NS)


def test_before_the_first_run_everything_is_zero(group: RateGroup) -> None:
    report = group.report()
    assert (report.hz, report.runs, report.merged, report.overruns) == (0.0, 0, 0, 0)
    assert set(astuple(report.lateness_us)) == set(astuple(report.exec_us)) == {0.0}


@given(values=st.lists(st.floats(0.0, 1e5), min_size=1, max_size=300))
def test_percentiles_are_exact_to_the_width_of_their_bin(values: list[float]) -> None:
    histogram = Histogram()
    for value in values:
        histogram.add(0.0, value)
    found = histogram.report()
    assert found.max == pytest.approx(max(values), abs=0.05 + 1e-9)  # half a tenth rounds either way
    for name, share in zip(("p50", "p99", "p999"), SHARES, strict=True):
        exact = float(np.quantile(values, share, method="inverted_cdf"))
        assert exact - 0.05 <= getattr(found, name) <= exact * (1.0 + 1.0 / 32.0) + 1.0


def test_what_is_beyond_the_last_bin_is_still_the_largest() -> None:
    histogram = Histogram()
    histogram.add(0.0, 1e12)
    assert histogram.report().max == 1e12


def test_the_horizon_forgets_and_the_worst_does_not() -> None:
    count = round(2.2 * HORIZON_NS / PERIOD_NS)
    report = recorded([900.0] + [5.0] * count).report()
    assert (report.runs, report.hz, report.lateness_us.worst, report.lateness_us.max) == (
        count + 1,
        pytest.approx(1_000.0, rel=1e-3),
        900.0,
        5.0,
    )
    assert recorded([900.0] + [5.0] * round(0.9 * HORIZON_NS / PERIOD_NS)).report().lateness_us.max == 900.0


def test_the_rate_is_that_of_the_horizon(group: RateGroup) -> None:
    for due in (*range(0, HORIZON_NS, PERIOD_NS), *range(HORIZON_NS, 5 * HORIZON_NS, 4 * PERIOD_NS)):
        group.record(due, due, due)
    assert group.report().hz == pytest.approx(250.0, rel=1e-2)


def test_merged_runs_and_overruns_are_counted(group: RateGroup) -> None:
    group.record(0, 100, PERIOD_NS)
    assert group.overruns == 0
    group.record(PERIOD_NS, PERIOD_NS, 2 * PERIOD_NS + 1)
    # late is as bad as slow: the next one is due
    group.record(2 * PERIOD_NS, 3 * PERIOD_NS, 3 * PERIOD_NS + 1, merged=3)
    # the delay counts from the first run that was missed
    assert (group.delay_ns, group.lateness_us) == (4 * PERIOD_NS + 1, pytest.approx(1e3))
    group.record(6 * PERIOD_NS, 6 * PERIOD_NS, 6 * PERIOD_NS + 1)
    assert (group.runs, group.merged, group.overruns, group.stalls) == (4, 3, 2, 0)


def test_a_stall_is_an_error_and_an_overrun_a_warning_for_as_long_as_the_horizon(group: RateGroup) -> None:
    stall_ns = round(ERROR_PERIODS * PERIOD_NS) + 1
    assert group.report().grade == "good"
    for due_ns, took_ns, grade in (
        (0, PERIOD_NS, "good"),
        (PERIOD_NS, PERIOD_NS + 1, "warning"),
        (2 * PERIOD_NS, stall_ns - 1, "warning"),
        (3 * PERIOD_NS, stall_ns, "error"),
        (4 * PERIOD_NS, 0, "error"),
        # forgotten after one to two horizons, while the counters stay
        (HORIZON_NS + PERIOD_NS, 0, "error"),
        (2 * HORIZON_NS + 2 * PERIOD_NS, 0, "good"),
    ):
        group.record(due_ns, due_ns, due_ns + took_ns)
        assert group.report().grade == grade, due_ns
    assert (group.overruns, group.stalls) == (3, 1)
