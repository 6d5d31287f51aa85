"""Two standard regressors without memory to compare the network with: support vectors and a forest (scikit-learn).

They live in the laboratory only: neither is ever saved or used by the daemon.
"""

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import RandomForestRegressor
from sklearn.svm import SVR

from tormagd.model.features import Scaling
from tormagd.training.dataset import Dataset
from tormagd.training.forward import require_fitted
from tormagd.training.splits import Mask

Array = NDArray[np.float64]


class SupportVectorForward:
    """Support-vector regression with a radial kernel on scaled features.

    Its cost grows with the square of the rows, so it learns from `rows` of them, drawn at random. `epsilon_N` is the
    width of the tube, best near the noise.
    """

    def __init__(self, rows: int = 2500, *, penalty: float = 30.0, width: float = 0.5, epsilon_N: float = 0.5) -> None:
        self._rows = rows
        self._penalty = penalty
        self._width = width
        self._epsilon_N = epsilon_N
        self._fitted: tuple[Scaling, SVR] | None = None

    def fit(self, data: Dataset, training: Mask) -> tuple[Scaling, SVR]:
        """See `ForwardModel.fit`."""
        known = np.flatnonzero(training)
        chosen = np.random.default_rng(0).permutation(known)[: self._rows]
        scaling = Scaling.fit(data.features[known], data.force_N[known])
        epsilon = self._epsilon_N * scaling.output_gain
        machine = SVR(kernel="rbf", C=self._penalty, gamma=self._width, epsilon=epsilon)
        target = (data.force_N[chosen] - scaling.output_offset) * scaling.output_gain
        machine.fit(scaling.scaled(data.features[chosen]), target)
        self._fitted = scaling, machine
        return self._fitted

    def predict(self, data: Dataset) -> Array:
        """See `ForwardModel.predict`."""
        scaling, machine = require_fitted(self._fitted)
        scaled: Array = machine.predict(scaling.scaled(data.features))
        return scaled / scaling.output_gain + scaling.output_offset


class ForestForward:
    """A random forest: piecewise constant, so it has no slope over the field for an inverse to follow."""

    def __init__(self, trees: int = 30, *, least_leaf: int = 3, seed: int = 0) -> None:
        self._trees = trees
        self._least_leaf = least_leaf
        self._seed = seed
        self._forest: RandomForestRegressor | None = None

    def fit(self, data: Dataset, training: Mask) -> RandomForestRegressor:
        """See `ForwardModel.fit`."""
        forest = RandomForestRegressor(
            self._trees, min_samples_leaf=self._least_leaf, random_state=self._seed, n_jobs=1
        )
        self._forest = forest.fit(data.features[training], data.force_N[training])
        return self._forest

    def predict(self, data: Dataset) -> Array:
        """See `ForwardModel.predict`."""
        forces: Array = require_fitted(self._forest).predict(data.features)
        return forces
