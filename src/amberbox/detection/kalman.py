"""Banks of Kalman filters: hypotheses about the same robot, and how probable each of them is.

Each model of a bank is a linear system ``x' = F x + w``, ``z = H x + v`` with ``w ~ N(0, Q)`` and
``v ~ N(0, R)``. With switching probabilities between models the bank is the interacting multiple
model filter (Bar-Shalom, Li, Kirubarajan: Estimation with Applications to Tracking and Navigation,
section 11.6.6); without them it is a plain bank (Roumeliotis, Sukhatme, Bekey 1998). Many robots
are one batch: arrays are ``(robots, models, ...)``, and a robot's numbers do not depend on the
others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
CLIP = 50.0
_FEW = 64  # so many matrices are faster one by one, if they are larger than this
_SMALL = 3
_LEAST = 5e-324  # a probability of 0 has no logarithm
_LOG_2PI = math.log(2 * math.pi)


@dataclass(frozen=True, slots=True)
class LinearModels:
    """The models of a bank for one step: arrays of ``(models, ...)`` or ``(robots, models, ...)``.

    ``f`` and ``q`` are n x n, ``h`` m x n, ``r`` m x m. Where ``masked`` (m) is true, the model
    does not use the sensor: its variance about what the model expects is that in ``r``, so that
    models with and without the sensor are compared fairly.
    """

    f: Floats
    q: Floats
    h: Floats
    r: Floats
    masked: Flags


@dataclass(slots=True)
class BankState:
    """Means ``(robots, models, n)``, covariances, and the probability of each model."""

    x: Floats
    p: Floats
    weights: Floats

    @classmethod
    def at(cls, x: Floats, p: Floats, weights: Floats, robots: int = 1) -> BankState:
        """Return the same state for all robots: ``x`` (n) and ``p`` (n, n) or one per model."""
        models, n = len(weights), x.shape[-1]
        return cls(
            np.broadcast_to(x, (robots, models, n)).copy(),
            np.broadcast_to(p, (robots, models, n, n)).copy(),
            np.broadcast_to(weights, (robots, models)).copy(),
        )

    def combined(self) -> tuple[Floats, Floats]:
        """Return mean ``(robots, n)`` and covariance of the mixture of all models."""
        mean = np.einsum("ri,rin->rn", self.weights, self.x)
        apart = self.x - mean[:, None, :]
        spread = np.einsum("ri,rin,rik->rnk", self.weights, apart, apart)
        return mean, np.einsum("ri,rink->rnk", self.weights, self.p) + spread


@dataclass(frozen=True, slots=True)
class StepResult:
    """What a step measured, per robot and model.

    ``log_likelihood`` of the sensors' values; each sensor's innovation, whitened by those of the
    sensors before it (``white``) and divided by its own standard deviation (``innovations``); both
    are 0 where the sensor was not read. ``used`` are the sensors that a model used.
    """

    log_likelihood: Floats
    white: Floats
    innovations: Floats
    used: Flags

    @property
    def nis(self) -> Floats:
        """Return the normalised innovation squared of the sensors that a model used."""
        return np.asarray(np.where(self.used, self.white * self.white, 0.0).sum(axis=-1))


def mix(state: BankState, switch: Floats) -> None:
    """Mix the models' states: ``switch[i, j]`` is P(model j now | model i before)."""
    prior = state.weights @ switch
    share = state.weights[:, None, :] * switch.T / prior[:, :, None]  # P(i before | j now)
    # about the mean of the models, so that little is lost where the spread is a difference
    mean = prior[:, None, :] @ state.x
    apart = state.x - mean
    robots, models, n = apart.shape
    before = (state.p + apart[..., :, None] * apart[..., None, :]).reshape(robots, models, n * n)
    mixed = share @ apart
    moments = (share @ before).reshape(robots, models, n, n)
    state.p = moments - mixed[..., :, None] * mixed[..., None, :]
    state.x = mixed + mean
    state.weights = prior


def predict(state: BankState, models: LinearModels) -> None:
    """Move all states one step ahead."""
    state.x = (models.f @ state.x[..., None])[..., 0]
    p = models.f @ state.p @ models.f.swapaxes(-1, -2).copy() + models.q
    state.p = 0.5 * (p + p.swapaxes(-1, -2))


def correct(state: BankState, models: LinearModels, z: Floats, floor: float) -> StepResult:
    """Use the sensors' values ``z`` (robots, m), NaN where one was not read, and weigh the models.

    No weight becomes less than the floor: without it, a bank that has long been sure of one model
    needs as long to believe another. A value that is more than 50 standard deviations from what is
    expected counts as one that is 50 from it, so that garbage does not carry the state away.
    """
    read = np.isfinite(z)[:, None, :]
    used = read & ~models.masked
    innovation = z[:, None, :] - (models.h @ state.x[..., None])[..., 0]
    h, r = models.h, models.r
    is_whole = bool(used.all())
    if not is_whole:
        innovation = np.where(read, innovation, 0.0)
        h, r = h * used[..., None], _noise(r, read, used)
    hp = h @ state.p
    s = hp @ h.swapaxes(-1, -2).copy() + r
    spread = np.sqrt(s.diagonal(0, -2, -1))
    apart = np.minimum(np.maximum(innovation / spread, -CLIP), CLIP)
    innovation = apart * spread
    log_roots, white = _whitened(s, np.concatenate((hp, innovation[..., None]), axis=-1))
    gain, residual = white[..., :-1].swapaxes(-1, -2), white[..., -1]
    state.x = state.x + (gain @ residual[..., None])[..., 0]
    state.p = state.p - gain @ gain.swapaxes(-1, -2)
    terms = residual * residual + (2 * log_roots + _LOG_2PI)
    log_likelihood = -0.5 * np.add.reduce(terms if is_whole else terms * read, axis=-1)
    state.weights = _reweighted(state.weights, log_likelihood, floor)
    return StepResult(log_likelihood, residual, apart, used)


def switching(models: int, stay: float) -> Floats:
    """Return switching probabilities: stay in a model, or change to any other alike."""
    if models == 1:
        return np.ones((1, 1))
    found = np.full((models, models), (1 - stay) / (models - 1))
    found.flat[:: models + 1] = stay
    return found


def _noise(r: Floats, read: Flags, used: Flags) -> Floats:
    """Return R with variance 1 for a sensor that was not read; one not used stands alone."""
    both = used[..., :, None] & used[..., None, :]
    alone = np.where(read[..., None], r, 1.0) * np.eye(r.shape[-1])
    return np.where(both, r, alone)


def _reweighted(weights: Floats, log_likelihood: Floats, floor: float) -> Floats:
    """Return weights times likelihoods, none below the floor, with the sum 1."""
    if len(weights) == 1:
        return np.array([_of_one(weights[0].tolist(), log_likelihood[0].tolist(), floor)])
    logs = np.log(np.maximum(weights, _LEAST)) + log_likelihood
    found = np.exp(logs - np.maximum.reduce(logs, axis=-1, keepdims=True))
    found = np.maximum(found / np.add.reduce(found, axis=-1, keepdims=True), floor)
    return np.asarray(found / np.add.reduce(found, axis=-1, keepdims=True))


def _of_one(weights: list[float], log_likelihood: list[float], floor: float) -> list[float]:
    """Return the same for one robot, whose few numbers are faster without arrays."""
    logs = [math.log(max(w, _LEAST)) + ll for w, ll in zip(weights, log_likelihood, strict=True)]
    most = max(logs)
    found = [math.exp(one - most) for one in logs]
    total = sum(found)
    found = [max(one / total, floor) for one in found]
    total = sum(found)
    return [one / total for one in found]


def _whitened(s: Floats, right: Floats) -> tuple[Floats, Floats]:
    """Return the logs of the diagonal of the roots L of ``s = L L'``, and ``L^-1 right``."""
    size = s.shape[-1]
    if size > _SMALL and s[..., 0, 0].size <= _FEW:
        root = np.linalg.cholesky(s)
        log_roots = np.log(np.diagonal(root, axis1=-2, axis2=-1))
        return log_roots, np.linalg.solve(root, right)
    rows = _root_rows(s.transpose(2, 3, 0, 1).copy())
    white = right.transpose(2, 0, 1, 3).copy()
    for i, row in enumerate(rows):
        solved = white[i]
        for k in range(i):
            solved -= row[k][..., None] * white[k]
        solved /= row[i][..., None]
    log_roots = np.log(np.array([row[i] for i, row in enumerate(rows)]))
    return log_roots.transpose(1, 2, 0), white.transpose(1, 2, 0, 3)


def _root_rows(s: Floats) -> list[list[Floats]]:
    """Return the rows of the lower roots of many small matrices ``(m, m, ...)``."""
    rows: list[list[Floats]] = []
    for i in range(len(s)):
        row: list[Floats] = []
        for j in range(i + 1):
            entry = s[i, j]
            other = row if j == i else rows[j]
            for k in range(j):
                entry = entry - row[k] * other[k]
            row.append(np.sqrt(entry) if j == i else entry / rows[j][j])
        rows.append(row)
    return rows
