"""The plane in which states are drawn: two columns of the observations, or their principal components."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.trajectory import FloatArray
from tcmrl_data.foundation.errors import TcmrlError
from tcmrl_data.store.keys import PartKey

SAMPLED_PARTS = 64
"""Parts that the plane and its borders are computed from, evenly spread over the dataset's."""

BORDER = 0.05
"""What the plane shows around the sampled states, as a share of their range."""


@dataclass(frozen=True)
class Plane:
    """A projection of observations to two coordinates.

    Attributes:
        names: of the coordinates.
        matrix: (observation_dim, 2).
        center: (observation_dim,), subtracted before.
        low: (2,), lower borders of what is drawn.
        high: (2,), upper borders.
        explained: share of the variance that two principal components keep; None of two columns.
    """

    names: tuple[str, str]
    matrix: FloatArray
    center: FloatArray
    low: FloatArray
    high: FloatArray
    explained: float | None

    def project(self, observations: FloatArray) -> FloatArray:
        """Coordinates (rows, 2) of observations (rows, observation_dim)."""
        points: FloatArray = (observations.astype(np.float64) - self.center) @ self.matrix
        return points


def choose_plane(dataset: Dataset, keys: Sequence[PartKey]) -> Plane:
    """The plane of a dataset, from some of its parts; their observations are read one part after another.

    Args:
        dataset: the dataset.
        keys: of its parts, at least one.
    """
    places = np.unique(np.linspace(0, len(keys) - 1, SAMPLED_PARTS).round().astype(int))
    sample = [keys[place] for place in places]
    width = _observations(dataset, sample[0]).shape[1]
    named = _named_columns(dataset)
    matrix: FloatArray = np.eye(width, 2)
    center: FloatArray = np.zeros(width)
    names, explained = named or ("first principal component", "second principal component"), None
    if named is None or width < 2:
        matrix, center, explained = _principal_components(dataset, sample, width)
    low, high = _borders(dataset, sample, matrix, center)
    return Plane(names, matrix, center, low, high, explained)


def _named_columns(dataset: Dataset) -> tuple[str, str] | None:
    """The environment's plane; None if it has none or is not installed."""
    try:
        return dataset.environment.plane
    except TcmrlError:
        return None


def _observations(dataset: Dataset, key: PartKey) -> FloatArray:
    found: FloatArray = dataset.arrays(*key, names=["observations"])["observations"]
    return found


def _principal_components(
    dataset: Dataset, sample: Sequence[PartKey], width: int
) -> tuple[FloatArray, FloatArray, float]:
    """Matrix, center and share of the variance of two principal components of standardized observations."""
    count, total, products = 0, np.zeros(width), np.zeros((width, width))
    for key in sample:
        rows = _observations(dataset, key).astype(np.float64)
        count += len(rows)
        total += rows.sum(axis=0)
        products += rows.T @ rows
    mean = total / max(count, 1)
    covariance = products / max(count, 1) - np.outer(mean, mean)
    deviation = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    scale = np.divide(1.0, deviation, out=np.zeros(width), where=deviation > 1e-6 * (1.0 + np.abs(mean)))
    values, vectors = np.linalg.eigh(covariance * np.outer(scale, scale))
    chosen = vectors[:, ::-1][:, :2]
    # The sign of an eigenvector is arbitrary: its largest entry becomes positive.
    chosen = chosen * np.sign(chosen[np.abs(chosen).argmax(axis=0), range(chosen.shape[1])])
    matrix = np.zeros((width, 2))
    matrix[:, : chosen.shape[1]] = scale[:, None] * chosen
    return matrix, mean, float(values[::-1][:2].sum() / max(values.sum(), 1e-12))


def _borders(
    dataset: Dataset, sample: Sequence[PartKey], matrix: FloatArray, center: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Lower and upper borders of the sampled states, with some room around them."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for key in sample:
        points = (_observations(dataset, key).astype(np.float64) - center) @ matrix
        finite = points[np.isfinite(points).all(axis=1)]
        if len(finite):
            low, high = np.minimum(low, finite.min(axis=0)), np.maximum(high, finite.max(axis=0))
    low, high = np.where(low <= high, low, 0.0), np.where(low <= high, high, 0.0)
    room = np.where(high > low, BORDER * (high - low), 1.0)
    return low - room, high + room
