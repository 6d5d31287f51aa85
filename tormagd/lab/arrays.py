"""What figures stand in: arrays of numbers, which rows of one are meant, and plain data."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Json = dict[str, Any]
