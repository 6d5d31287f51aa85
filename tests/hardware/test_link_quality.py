"""How well the wire carries, in figures: what is lost, damaged and not taken, within the last second."""

import pytest

from tormagd.hardware.link_quality import LOOKED_S, LOOKS, LOSES, SETTLING_LOOKS, Counts, LinkQuality, LinkWatch


def watched(looks: list[Counts]) -> LinkQuality:
    """The quality after these counters, a look apart."""
    watch, now_s, quality = LinkWatch(0.0), 0.0, LinkQuality()
    total = Counts()
    for step in looks:
        total = Counts(*[getattr(total, name) + getattr(step, name) for name in Counts.__match_args__])
        while not watch.is_due(now_s):
            now_s += 1e-3
        quality = watch.look(now_s, total, 7e-4, 2e-5)
    return quality


GOOD = Counts(drives=100, states=100, frames=205, damaged=0, unsent=0)


def test_a_wire_in_order() -> None:
    assert watched([GOOD] * 20) == LinkQuality(0.0, 0.0, 0.0, 7e-4, 2e-5)
    assert not watched([GOOD] * 20).is_lossy


def test_nothing_is_said_before_the_first_answers_have_come() -> None:
    watch = LinkWatch(5.0)
    assert not watch.is_due(5.0 + (SETTLING_LOOKS - 0.1) * LOOKED_S)
    assert watch.is_due(5.0 + (SETTLING_LOOKS + 0.1) * LOOKED_S)
    assert watch.look(5.3, Counts(3, 0, 0, 0, 0), 0.0, 0.0) == LinkQuality(), "one look alone is no second"


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
    bad = GOOD.replaced(**change)
    quality = watched([GOOD] * 3 + [bad] * 11)
    assert getattr(quality, name) == pytest.approx(share)
    assert quality.is_lossy
    assert share > LOSES
    # the shares of one bad look among the ten of a second
    assert getattr(watched([GOOD] * 12 + [bad]), name) <= share / LOOKS * 2.0
    assert not watched([bad] * 12 + [GOOD] * 12).is_lossy


def test_a_round_trip_is_long_once_two_looks_have_found_it_so() -> None:
    watch = LinkWatch(0.0)
    found = [watch.look(0.1 * look, GOOD, trip_s, 0.0).round_trip_s for look, trip_s in enumerate((1e-3, 2e-2, 1e-3))]
    assert found[1:] == [1e-3, 1e-3]
    assert [watch.look(1.0, GOOD, 2e-2, 0.0).round_trip_s for _ in range(2)] == [1e-3, 2e-2]


def test_it_says_its_figures() -> None:
    text = str(LinkQuality(0.05, 0.021, 0.3, 0.0152, 0.0))
    assert all(figure in text for figure in ("5.0%", "2.1%", "30.0%", "15.2 ms"))
