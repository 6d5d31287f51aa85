"""The typed error survives the way out of another process."""

import pickle

import numpy as np
import pytest

from tormagd.physics.errors import DomainError, require


def test_an_error_can_be_sent_between_processes() -> None:
    with pytest.raises(DomainError) as caught:
        require("gap_mm", np.array([50.0, -1.0]), 0.0, 100.0)
    copy = pickle.loads(pickle.dumps(caught.value))
    assert type(copy) is DomainError
    assert str(copy) == str(caught.value)
    assert (copy.variable, copy.value, copy.allowed) == ("gap_mm", -1.0, "a number from 0 to 100")
