"""The elastomer's energy density against tensors and against the thesis's own stress, Eq. 27."""

import numpy as np
import pytest

from tormag_lab.design.energy import energy_at_shaft, invariants
from tormagd.element.physics.force import MU0_H_M, Elastomer

ELASTOMER = Elastomer(277e3, 4.0, 0.2)


@pytest.mark.parametrize(("radial", "hoop"), [(1.0, 1.0), (0.6, 1.0), (0.8, 1.3), (2.0, 0.4)])
def test_invariants_are_those_of_the_tensor(radial: float, hoop: float) -> None:
    stretches = radial, hoop, 1.0 / (radial * hoop)
    tensor = np.diag(np.square(stretches))
    second = (np.trace(tensor) ** 2 - np.trace(tensor @ tensor)) / 2.0
    assert invariants(*stretches) == pytest.approx((np.trace(tensor), second, 1.0))


@pytest.mark.parametrize("radial", [0.3, 0.7, 0.95, 1.2])
@pytest.mark.parametrize("of_first", [0.0, 0.4, 1.0])
def test_the_energy_rises_as_the_stress_says(radial: float, of_first: float) -> None:
    step, field_T = 1e-6, 0.2
    first, second = (share * ELASTOMER.shear_modulus_Pa / 2.0 for share in (of_first, 1.0 - of_first))
    total = [sum(energy_at_shaft(radial + each, field_T, ELASTOMER)) for each in (-step, step)]
    squares = np.array([radial**2, 1.0, radial**-2])
    stress = 2.0 * first * squares + 2.0 * second * (squares.sum() * squares - squares**2)
    stress[0] += (radial * field_T) ** 2 / (MU0_H_M * ELASTOMER.relative_permeability)
    # the pressure that keeps the volume falls out of the difference
    assert radial * (total[1] - total[0]) / (2.0 * step) == pytest.approx(stress[0] - stress[2], rel=1e-6)
