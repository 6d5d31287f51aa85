"""The thesis's device and use cases, as the design tests want them."""

import pytest

from tormagd.lab.design.brake import Brake
from tormagd.lab.design.optimisation import Design, Problem
from tormagd.lab.design.phase_portrait import Region
from tormagd.physics.field import PowerFieldLaw
from tormagd.physics.force import TORMAG, Elastomer


@pytest.fixture(scope="session")
def brake() -> Brake:
    """The device as built, with the elastomer of chapter 3."""
    return Brake(PowerFieldLaw(), Elastomer(300e3, 3.8, 0.2), TORMAG, 45.0, 95.0)


@pytest.fixture(scope="session")
def use_case_1() -> Region:
    return Region(0.0, 0.0, 2.5, 1.0)


@pytest.fixture(scope="session")
def use_case_2() -> Region:
    return Region(0.5, 0.25, 3.0, 1.0)


@pytest.fixture(scope="session")
def problem(use_case_2: Region) -> Problem:
    """Use case 2 by the true boundary at a fast gap."""
    return Problem(use_case_2, "true", 40.0)


@pytest.fixture(scope="session")
def as_built() -> Design:
    return Design(11.0, 20.0, 95.0)
