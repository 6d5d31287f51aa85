"""Who holds the brake."""

import pytest

from tormagd.daemon.hold import Hold, is_passed

ORDER = ("patient", "console")


@pytest.mark.parametrize(
    ("holder", "other", "passed"),
    [
        ("patient", "console", False),
        ("console", "patient", True),
        ("a", "console", True),
        ("patient", "a", False),
        ("a", "b", False),
    ],
)
def test_what_is_listed_goes_before_what_comes_later_or_is_not(holder: str, other: str, passed: bool) -> None:
    assert is_passed(Hold(holder), other, ORDER, is_stale=False) == passed
    assert is_passed(Hold(holder), other, ORDER, is_stale=True)
    assert not is_passed(Hold(holder, is_given=True), other, ORDER, is_stale=False)
    assert not is_passed(Hold(holder), other, (), is_stale=False)
