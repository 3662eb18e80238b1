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
from collections.abc import Sequence
from dataclasses import dataclass
from operator import gt, mul

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
CLIP = 50.0
_FEW = 64  # so many matrices are faster one by one, if they are larger than this
_SMALL = 3  # so many sensors of one robot are faster without arrays
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


@dataclass(frozen=True, slots=True)
class StepOfOne:
    """What a step of one robot gave: all weights, and the best model's part of a ``StepResult``."""

    weights: list[float]
    white: list[float]
    innovations: list[float]
    used: list[bool]


def mix(state: BankState, switch: Floats) -> None:
    """Mix the models' states: ``switch[i, j]`` is P(model j now | model i before)."""
    prior = state.weights.dot(switch)  # faster than @ where there are few numbers
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


def correct_one(
    state: BankState, models: LinearModels, z: Sequence[float], floor: float
) -> StepOfOne:
    """Do what ``correct`` does, for one robot and the values of its sensors, in less time.

    The numbers of up to three sensors are so few that they are faster without arrays.
    """
    if len(z) > _SMALL:
        found = correct(state, models, np.array([z]), floor)
        best = int(state.weights[0].argmax())
        parts = (found.white, found.innovations, found.used)
        white, innovations, used = (part[0, best].tolist() for part in parts)
        return StepOfOne(state.weights[0].tolist(), white, innovations, used)
    h, r = models.h, models.r
    is_read = list(map(math.isfinite, z))
    uses = [list(map(gt, is_read, hides)) for hides in models.masked.tolist()]  # read, not hidden
    if not all(map(all, uses)):
        read, used = np.array(is_read), np.array(uses)
        h, r = h * used[..., None], _noise(r, read, used)
    expected = (models.h @ state.x[0, :, :, None])[..., 0].tolist()
    hp = h @ state.p[0]
    s = hp @ h.swapaxes(-1, -2) + r
    solved, apart, logs = [], [], []
    for variances, means, weight in zip(
        s.tolist(), expected, state.weights[0].tolist(), strict=True
    ):
        innovations = [
            value - mean if there else 0.0
            for value, mean, there in zip(z, means, is_read, strict=True)
        ]
        rows, own, log_likelihood = _solved(variances, innovations)
        solved.append(rows)
        apart.append(own)
        logs.append(math.log(max(weight, _LEAST)) + log_likelihood)
    white = np.array(solved)
    gain = (white[..., :-1] @ hp).swapaxes(-1, -2)
    state.x = state.x + (gain @ white[..., -1:])[..., 0]
    state.p = state.p - gain @ gain.swapaxes(-1, -2)
    weights = _normalised(logs, floor)
    state.weights = np.array([weights])
    best = weights.index(max(weights))
    return StepOfOne(weights, [row[-1] for row in solved[best]], apart[best], uses[best])


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
    logs = np.log(np.maximum(weights, _LEAST)) + log_likelihood
    found = np.exp(logs - np.maximum.reduce(logs, axis=-1, keepdims=True))
    found = np.maximum(found / np.add.reduce(found, axis=-1, keepdims=True), floor)
    return np.asarray(found / np.add.reduce(found, axis=-1, keepdims=True))


def _normalised(logs: list[float], floor: float) -> list[float]:
    """Return the weights of one robot whose logarithms are given, none below the floor."""
    most = max(logs)
    found = [math.exp(one - most) for one in logs]
    total = sum(found)
    found = [max(one / total, floor) for one in found]
    total = sum(found)
    return [one / total for one in found]


def _solved(
    s: list[list[float]], innovations: list[float]
) -> tuple[list[list[float]], list[float], float]:
    """Return ``L^-1 [1 | innovations]`` for the lower root L of ``s``, and what it tells.

    That is each innovation, cut, in its own standard deviations, and the logarithm of their
    likelihood but for a constant.
    """
    rows: list[list[float]] = []
    apart, doubt = [], 0.0
    for i, row in enumerate(s):
        spread = math.sqrt(row[i])
        size = innovations[i] / spread
        size = CLIP if size > CLIP else -CLIP if size < -CLIP else size
        apart.append(size)
        variance = row[i]
        own = [0.0] * len(s)
        own[i] = 1.0
        own.append(size * spread)
        for before in rows:
            root = sum(map(mul, before, row))
            variance -= root * root
            own = [one - root * other for one, other in zip(own, before, strict=True)]
        scale = 1.0 / math.sqrt(variance)
        rows.append([scale * one for one in own])
        doubt += math.log(variance) + rows[i][-1] ** 2
    return rows, apart, -0.5 * doubt


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
