"""The force of arrays too large for one block, whatever their layout."""

from typing import Any

import numpy as np
import pytest

from tormagd.physics.errors import DomainError
from tormagd.physics.force import TORMAG, Elastomer, brake_force_masked_N, brake_force_N

STIFF = Elastomer(277.3e3, 4.0, 0.2)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_blocks_do_not_show(dtype: Any) -> None:
    moments = np.linspace(0.0, 3e-3, 30_003, dtype=dtype).reshape(3, 10_001)
    expected = np.array([[brake_force_N(float(one), STIFF, TORMAG) for one in row[::50]] for row in moments])
    for layout in (moments, np.asfortranarray(moments), np.repeat(moments, 2, axis=1)[:, ::2]):
        force = brake_force_N(layout, STIFF, TORMAG)
        assert force.dtype == dtype
        assert force.shape == moments.shape
        np.testing.assert_allclose(force[:, ::50], expected, rtol=64 * np.finfo(dtype).eps)
    np.testing.assert_array_equal(brake_force_N(moments.T, STIFF, TORMAG), brake_force_N(moments, STIFF, TORMAG).T)
    force, admissible = brake_force_masked_N(moments, STIFF, TORMAG)
    assert admissible.all()
    np.testing.assert_array_equal(force, brake_force_N(moments, STIFF, TORMAG))


def test_one_bad_value_in_a_large_array_is_refused() -> None:
    moments = np.full(20_000, 1e-3)
    moments[15_000] = np.nan
    with pytest.raises(DomainError, match="radial_moment_Tm = nan"):
        brake_force_N(moments, STIFF, TORMAG)
