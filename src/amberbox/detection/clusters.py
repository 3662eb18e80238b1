"""Soft clusters: principal components and a Gaussian mixture of vectors, and what lies outside.

As Li and Parker (2008): principal components first, then soft clusters. What the components leave
out counts as noise of one variance (probabilistic principal components, Tipping and Bishop 1999),
so that a vector that leaves their subspace is outside as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.detection.channels import Floats, as_floats

_LEAST_VARIANCE = 0.01
_LEAST_CLUSTER = 0.01  # variance of a cluster in whitened components
_APART = 3.0
_LEAST_WEIGHT = 0.02  # of a cluster: what is rarer, such as a change of states, is no state
_ROUNDS = 40
_VECTORS_PER_NUMBER = 3  # that a mixture must have for each number that it learns


@dataclass(frozen=True, slots=True)
class Clusters:
    """A mixture of Gaussians in q whitened principal components of vectors of p numbers.

    ``center`` (p), ``basis`` (q, p) with the components divided by their standard deviations,
    ``noise`` (1) the variance of what they leave out, ``means`` and ``variances`` (k, q) and
    ``log_weights`` (k) of the clusters.
    """

    center: Floats
    basis: Floats
    deviations: Floats
    noise: Floats
    means: Floats
    variances: Floats
    log_weights: Floats

    def __len__(self) -> int:
        return len(self.means)

    def locate(self, vector: Floats) -> tuple[Floats, float]:
        """Return the probability of each cluster, and the distance from the nearest.

        The distance is the root of the mean square deviation, in standard deviations.
        """
        apart = vector - self.center
        place = (self.basis * apart).sum(axis=1)
        squares = ((place - self.means) ** 2 / self.variances).sum(axis=1)
        logs = self.log_weights - 0.5 * squares - 0.5 * np.log(self.variances).sum(axis=1)
        shares = np.exp(logs - logs.max())
        left = apart - ((place * self.deviations)[:, None] * self.directions).sum(axis=0)
        outside = float((left * left).sum()) / float(self.noise[0])
        distance = (float(squares.min()) + outside) / len(vector)
        return shares / shares.sum(), float(np.sqrt(distance))

    @property
    def directions(self) -> Floats:
        """Return the principal components as vectors of unit deviation, (q, p)."""
        return np.asarray(self.basis * self.deviations[:, None])

    def contributions(self, vector: Floats) -> Floats:
        """Return how much each of the p numbers adds to the distance; none is negative."""
        apart = vector - self.center
        place = (self.basis * apart).sum(axis=1)
        nearest = int(np.argmin(((place - self.means) ** 2 / self.variances).sum(axis=1)))
        mean, directions = self.means[nearest], self.directions
        from_mean = apart - (mean * self.deviations) @ directions
        inside = (place - mean) / self.variances[nearest]
        left = apart - (place * self.deviations) @ directions
        pull = inside @ self.basis + left / self.noise[0]
        return np.asarray(np.maximum(from_mean * pull, 0.0))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return its arrays by name; for ``restored``."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def restored(cls, arrays: Mapping[str, NDArray[Any]], size: int) -> Clusters:
        """Make clusters of vectors of ``size`` numbers; raises ValueError if they do not fit."""
        k, q = arrays["means"].shape
        shapes = ((size,), (q, size), (q,), (1,), (k, q), (k, q), (k,))
        found = cls(*(
            as_floats(arrays[field.name], shape)
            for field, shape in zip(fields(cls), shapes, strict=True)
        ))  # fmt: skip
        if k == 0 or not ((found.variances > 0).all() and found.noise[0] > 0):
            raise ValueError("no clusters, or a variance that is not above 0")
        return found


def learn_clusters(vectors: Floats, most: int, explained: float, seed: int = 0) -> Clusters:
    """Return 1 to ``most`` clusters of vectors (n, p), n at least 2, by the integrated likelihood.

    That is the Bayesian criterion with the entropy of the assignments (Biernacki et al. 2000), by
    which clusters that overlap become one.

    ``explained`` is the share of the variance that the principal components keep. With few vectors
    the covariance is drawn towards equal variances.
    """
    count, size = vectors.shape
    center = vectors.mean(axis=0)
    apart = vectors - center
    covariance = apart.T @ apart / (count - 1)
    shrink = size / (size + count)
    covariance *= 1 - shrink
    covariance += np.eye(size) * max(shrink * float(np.trace(covariance)) / size, _LEAST_VARIANCE)
    values, columns = np.linalg.eigh(covariance)
    values, columns = values[::-1], columns[:, ::-1]
    kept = int(np.searchsorted(np.cumsum(values) / values.sum(), explained)) + 1
    kept = min(kept, size)
    noise = float(values[kept:].mean()) if kept < size else float(values[-1])
    deviations = np.sqrt(values[:kept])
    basis = np.ascontiguousarray((columns[:, :kept] / deviations).T)
    places = apart @ basis.T
    best = _mixture(places, 1, seed)
    for number in range(2, most + 1):
        if count < _VECTORS_PER_NUMBER * number * (2 * kept + 1):
            break
        found = _mixture(places, number, seed)
        if found.criterion < best.criterion:
            best = found
    means, variances, weights = _merged(best.means, best.variances, np.exp(best.log_weights))
    usual = weights >= min(_LEAST_WEIGHT, float(weights.max()))
    means, variances, weights = means[usual], variances[usual], weights[usual]
    noises = np.array([noise])
    return Clusters(center, basis, deviations, noises, means, variances, np.log(weights))


@dataclass(frozen=True, slots=True)
class _Mixture:
    means: Floats
    variances: Floats
    log_weights: Floats
    criterion: float


def _mixture(places: Floats, number: int, seed: int) -> _Mixture:
    """Return a mixture of Gaussians with diagonal covariances, by expectation maximisation."""
    count, size = places.shape
    means = _spread_out(places, number, seed)
    variances = np.ones((number, size))
    log_weights = np.full(number, -np.log(number))
    total = -np.inf
    for _ in range(_ROUNDS):
        logs = np.empty((count, number))
        for k in range(number):
            squares = ((places - means[k]) ** 2 / variances[k]).sum(axis=1)
            logs[:, k] = log_weights[k] - 0.5 * (squares + np.log(variances[k]).sum())
        best = logs.max(axis=1, keepdims=True)
        shares = np.exp(logs - best)
        sums = shares.sum(axis=1, keepdims=True)
        before, total = total, float((np.log(sums) + best).sum())
        shares /= sums
        weights = np.maximum(shares.sum(axis=0), 1e-9)
        means = (shares.T @ places) / weights[:, None]
        squares = (shares.T @ places**2) / weights[:, None] - means**2
        variances = np.maximum(squares, _LEAST_CLUSTER)
        log_weights = np.log(weights / count)
        if total - before < 1e-6 * count:
            break
    entropy = -float((shares * np.log(np.maximum(shares, 1e-300))).sum())
    criterion = -2 * total + number * (2 * size + 1) * np.log(count) + 2 * entropy
    return _Mixture(means, variances, log_weights, float(criterion))


def _merged(means: Floats, variances: Floats, weights: Floats) -> tuple[Floats, Floats, Floats]:
    """Merge clusters less than three standard deviations apart: noise within one state."""
    while len(means) > 1:
        apart = means[:, None, :] - means
        squares = (apart**2 / np.minimum(variances[:, None, :], variances)).sum(axis=2)
        np.fill_diagonal(squares, np.inf)
        i, j = divmod(int(np.argmin(squares)), len(means))
        if squares[i, j] > _APART**2:
            break
        share = weights[j] / (weights[i] + weights[j])
        between = share * (1 - share) * (means[i] - means[j]) ** 2
        means[i] += share * (means[j] - means[i])
        variances[i] += share * (variances[j] - variances[i]) + between
        weights[i] += weights[j]
        means, variances, weights = (
            np.delete(one, j, axis=0) for one in (means, variances, weights)
        )
    return means, variances, weights


def _spread_out(places: Floats, number: int, seed: int) -> Floats:
    """Return starting points far from each other (k-means++)."""
    random = np.random.default_rng(seed)
    chosen = [places[int(random.integers(len(places)))]]
    nearest = np.full(len(places), np.inf)
    while len(chosen) < number:
        nearest = np.minimum(nearest, ((places - chosen[-1]) ** 2).sum(axis=1))
        total = float(nearest.sum())
        if total == 0:
            chosen.append(chosen[0])
            continue
        draw = random.random() * total
        chosen.append(places[min(int(np.searchsorted(np.cumsum(nearest), draw)), len(places) - 1)])
    return np.array(chosen)
