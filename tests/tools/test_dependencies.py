"""What is fetched beside the core is what pip would fetch with it."""

import re
from importlib.metadata import requires

import pytest
from dependencies import requirements


def named(requirement: str) -> str:
    return re.split(r"[^A-Za-z0-9_.-]", requirement, maxsplit=1)[0].lower()


def test_extras_of_extras_are_followed() -> None:
    everything = requirements(["all", "dev"])
    assert set(requirements(["demo"])) < set(everything)
    assert not any(requirement.startswith("tormag") for requirement in everything)
    both = [*(requires("tormagd") or []), *(requires("tormag-lab") or [])]
    installed = {named(requirement) for requirement in both} - {"tormagd", "tormagd-client", "tormag-lab"}
    assert {named(requirement) for requirement in everything} == installed


def test_an_extra_that_is_none_is_refused() -> None:
    with pytest.raises(KeyError, match="deb"):
        requirements(["deb"])
