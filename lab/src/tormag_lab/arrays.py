"""Type aliases for arrays, masks and plain data, and the root mean square."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Json = dict[str, Any]


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
