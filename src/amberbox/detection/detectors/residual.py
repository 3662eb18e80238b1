"""Residuals: the difference between what variables are and what they should be, given the others.

Two models of what they should be. A vector autoregression, learnt with ridge regression from
nominal missions, predicts each message from the last values of all variables before it. Recursive
least squares (Keipour et al., IROS 2019) predicts a declared output, such as a measured speed, from
its inputs, such as the commanded one, and goes on learning during the mission. Residuals of the
first are whitened (ZCA-cor, Kessy et al. 2018), so that each belongs to one variable; those of the
second are divided by their running standard deviation.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.config import Finding
from amberbox.core.contracts import LearntState, MissionRows, Row, Score, ScoreReason
from amberbox.core.errors import AmberboxError
from amberbox.core.options import option
from amberbox.detection.channels import (
    CLIP,
    Channels,
    Floats,
    add_count,
    as_floats,
    as_number,
    learn_channels,
)
from amberbox.detection.learnt_options import (
    only_value_errors,
    options_from_json,
    options_to_json,
)

_BLOCK = 256
_LEAST_SPREAD = 0.01  # of a residual, in standard deviations of its variable
_SHRINK = 0.05  # of the correlation of residuals towards none
_CLIPPED, _LITTLE = 4.0, 0.02  # standard deviations: what is further away is learnt so little
_LEARNT_ROWS, _MOST_ROWS = 100.0, 1000.0  # how much the mean of residuals before a mission weighs
_START_VARIANCE = 100.0
_MOST_TRACE = 1e6
_LISTED = 5


@dataclass(frozen=True, slots=True)
class PairOptions:
    """An output and the inputs that it follows from."""

    output: str = option(doc="the variable that is predicted, ITEM.VARIABLE")
    inputs: Sequence[str] = option(doc="the variables that it follows from, ITEM.VARIABLE")
    input_lags: int = option(2, "how many values of each input count: the newest, the one before")
    output_lags: int = option(1, "how many earlier values of the output count; 0 for none")

    def check(self) -> Iterator[Finding]:
        """Refuse pairs that have nothing to predict from."""
        if not self.inputs:
            yield "inputs", "list at least one variable"
        if self.output in self.inputs:
            yield "inputs", "the output cannot be its own input; see output_lags"
        if not 1 <= self.input_lags <= 20:
            yield "input_lags", "must lie between 1 and 20"
        if not 0 <= self.output_lags <= 20:
            yield "output_lags", "must lie between 0 and 20"


@dataclass(frozen=True, slots=True)
class ResidualOptions:
    """Which variables are predicted from which."""

    variables: Sequence[str] = option(
        (), "those of the autoregression, ITEM.VARIABLE; all if empty"
    )
    regression: bool = option(True, "predict each variable from the last values of all")
    lags: int = option(1, "how many earlier messages of its own item a variable is predicted from")
    ridge: float = option(0.01, "how much coefficients are drawn to 0")
    pairs: Sequence[PairOptions] = option((), "outputs and the inputs that they follow from")
    forget: float = option(0.999, "weight of an earlier message in a pair, per message")
    smoothing: float = option(0.2, "weight of the newest message in the score; 1 for no smoothing")

    def check(self) -> Iterator[Finding]:
        """Refuse values outside their ranges."""
        if not 1 <= self.lags <= 20:
            yield "lags", "must lie between 1 and 20"
        if not 0 < self.ridge < np.inf:
            yield "ridge", "must lie above 0"
        if not 0.9 <= self.forget <= 1:
            yield "forget", "must lie between 0.9 and 1"
        if not 0 < self.smoothing <= 1:
            yield "smoothing", "must lie above 0, and be 1 at most"
        outputs = [pair.output for pair in self.pairs]
        if len(set(outputs)) < len(outputs):
            yield "pairs", "an output is there twice; list all its inputs in one pair"


Config = ResidualOptions
SAMPLE = """\
pairs:
  - output: odometry.speed
    inputs: [command.speed]
"""


class Detector:
    """Scores each item by the residuals of its variables, and each pair by that of its output."""

    version = 1

    def __init__(self, config: ResidualOptions) -> None:
        self.config = config
        self.counts: dict[str, int] = {}
        self._set_up(Channels.none())

    def _set_up(self, channels: Channels) -> None:
        self._channels = channels
        self._regressions: dict[str, _Regression] = {}
        self._start: list[_Pair] = []
        self.begin(0)

    def fit(self, missions: Sequence[MissionRows]) -> None:
        """Learn scales, coefficients, and how large residuals are in nominal missions."""
        config = self.config
        paired = [name for pair in config.pairs for name in (pair.output, *pair.inputs)]
        wanted = config.variables if config.regression else paired
        if not config.regression and not config.pairs:
            raise AmberboxError("nothing to predict", "list 'pairs', or set 'regression: true'")
        self._set_up(learn_channels(missions, self.counts, wanted, paired))
        self._start = [_Pair.new(pair, self._channels) for pair in config.pairs]
        sums = {item: _Sums(*self._sizes(item)) for item in self._learnt_items()}
        longest = dict.fromkeys(self._channels.items, 0)
        for mission in missions:
            self.begin(mission.span[0])
            for row in mission:
                read = self._read(row)
                if read is None:
                    continue
                if read.gap_ns is not None:
                    longest[row.item] = max(longest[row.item], read.gap_ns)
                if read.regressors is not None and row.item in sums:
                    sums[row.item].add(read.regressors, read.values)
                for pair in self._pairs_of(row.item, read):
                    pair.observe(self._held, config)
            self._start = [pair.for_next_mission() for pair in self._pairs]
        for item, found in sums.items():
            learnt = found.solved(config.ridge)
            if learnt is not None:
                self._regressions[item] = _Regression(*learnt)
        self._longest_ns = longest
        self.begin(0)

    def _learnt_items(self) -> list[str]:
        return list(self._channels.items) if self.config.regression else []

    def _sizes(self, item: str) -> tuple[int, int]:
        own = len(self._channels.items[item].variables)
        return 1 + len(self._channels) + (self.config.lags - 1) * own, own

    def begin(self, at_ns: int) -> None:
        """Forget the messages before a mission."""
        self._held = np.zeros(len(self._channels))
        self._before: dict[str, list[Floats]] = {}
        self._last_ns: dict[str, int] = {}
        self._squares: dict[str, Floats] = {}
        self._pairs = [pair.copy() for pair in self._start]
        self._longest_ns = getattr(self, "_longest_ns", {})

    def observe(self, row: Row) -> Sequence[Score]:
        """Return the scores of the row's item, and of the pairs whose output it has."""
        read = self._read(row)
        if read is None:
            return ()
        scores = []
        regression = self._regressions.get(row.item)
        if regression is not None and read.regressors is not None:
            if (read.gap_ns or 0) > 2 * self._longest_ns.get(row.item, 0):
                add_count(self.counts, "messages after a gap longer than learnt, without a score")
            else:
                squares = regression.squares(read.regressors, read.values)
                smooth = _smoothed(self._squares.get(row.item), squares, self.config.smoothing)
                self._squares[row.item] = smooth
                scores.append(Score(row.at_ns, row.item, float(np.sqrt(smooth.mean()))))
        for pair in self._pairs_of(row.item, read):
            if pair.observe(self._held, self.config):
                scores.append(Score(row.at_ns, pair.output, pair.score))
        return scores

    def _pairs_of(self, item: str, read: _Read) -> Iterator[_Pair]:
        """Yield the pairs whose output a message has, if it and all inputs are known."""
        start = self._channels.items[item].where.start
        for pair in self._pairs:
            is_of_item = pair.items[0] == item
            if not is_of_item or not all(other in self._last_ns for other in pair.items):
                continue
            if not np.isnan(read.values[pair.position - start]):
                yield pair

    def _read(self, row: Row) -> _Read | None:
        """Hold the values of a row; return them, and what they can be predicted from."""
        scaled = self._channels.scaled(row, self.counts)
        if scaled is None:
            return None
        where, values = scaled
        before = self._before.setdefault(row.item, [])
        own = self._held[where]
        lags = self.config.lags
        regressors = None
        last_ns = self._last_ns.get(row.item)
        if last_ns is not None and len(before) == lags - 1:
            regressors = np.concatenate([_ONE, self._held, *before])
        if last_ns is not None and lags > 1:
            before.insert(0, own.copy())
            del before[lags - 1 :]
        gap_ns = None if last_ns is None else row.at_ns - last_ns
        self._last_ns[row.item] = row.at_ns
        self._held[where] = np.where(np.isnan(values), own, values)
        return _Read(values, regressors, gap_ns)

    def tick(self, now_ns: int) -> Sequence[Score]:
        """Return no scores: silence changes none."""
        return ()

    def explain(self, series: str) -> ScoreReason:
        """Return the variables with the largest residuals."""
        pair = next((pair for pair in self._pairs if pair.output == series), None)
        if pair is not None:
            item, variable = self._channels.names[pair.position]
            text = f"{series} is {pair.score:.3g} standard deviations from what its inputs give"
            return ScoreReason("pair", item, variable, text, ((series, pair.score),))
        variables = self._channels.items[series].variables
        squares = self._squares[series]
        order = np.argsort(-squares, kind="stable")[:_LISTED]
        total = float(squares.sum()) or 1.0
        shares = tuple((f"{series}.{variables[i]}", float(squares[i]) / total) for i in order)
        worst = variables[order[0]]
        size = float(np.sqrt(squares[order[0]]))
        text = f"{series}.{worst} is {size:.3g} standard deviations from its prediction"
        return ScoreReason("regression", series, worst, text, shares)

    def learnt(self) -> LearntState:
        """Return channels, coefficients and pairs."""
        names, arrays = self._channels.learnt()
        for number, item in enumerate(sorted(self._regressions)):
            arrays[f"coefficients_{number}"] = self._regressions[item].coefficients
            arrays[f"whitening_{number}"] = self._regressions[item].whitening
        values = {
            "options": options_to_json(self.config),
            "channels": names,
            "items": sorted(self._regressions),
            "longest_ns": self._longest_ns,
            "pairs": [pair.state() for pair in self._start],
        }
        return LearntState(values, arrays)

    @only_value_errors()
    def restore(self, state: LearntState) -> None:
        """Restore what was learnt."""
        values, arrays = state.values, state.arrays
        self.config = options_from_json(Config, values["options"])
        self._set_up(Channels.restored(values["channels"], arrays))
        for number, item in enumerate(values["items"]):
            rows, own = self._sizes(item)
            self._regressions[item] = _Regression(
                as_floats(arrays[f"coefficients_{number}"], (rows, own)),
                as_floats(arrays[f"whitening_{number}"], (own, own)),
            )
        self._longest_ns = {str(item): int(gap) for item, gap in values["longest_ns"].items()}
        self._start = [_Pair.new(pair, self._channels) for pair in self.config.pairs]
        self._pairs = self._start
        self._resume_pairs(values["pairs"])
        self.begin(0)

    def _resume_pairs(self, states: Sequence[Mapping[str, Any]]) -> None:
        for pair, state in zip(self._pairs, states, strict=True):
            pair.resume(state)

    def snapshot(self) -> dict[str, Any]:
        """Return the values that are held, and the pairs as learnt so far."""
        return {
            "held": self._held.tolist(),
            "before": {item: [b.tolist() for b in rows] for item, rows in self._before.items()},
            "last_ns": self._last_ns,
            "squares": {item: squares.tolist() for item, squares in self._squares.items()},
            "pairs": [pair.state() for pair in self._pairs],
        }

    @only_value_errors()
    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Continue a mission."""
        self.begin(0)
        own = {item: (len(held.variables),) for item, held in self._channels.items.items()}
        self._held = as_floats(np.array(snapshot["held"], float), self._held.shape)
        self._before = {
            item: [as_floats(np.array(row), own[item]) for row in rows]
            for item, rows in snapshot["before"].items()
        }
        self._last_ns = {item: int(at) for item, at in snapshot["last_ns"].items()}
        self._squares = {
            item: as_floats(np.array(row), own[item]) for item, row in snapshot["squares"].items()
        }
        self._resume_pairs(snapshot["pairs"])


_ONE = np.ones(1)


@dataclass(frozen=True, slots=True)
class _Read:
    values: Floats
    regressors: Floats | None
    gap_ns: int | None


class _Sums:
    """The sums over messages that ridge regression needs."""

    def __init__(self, regressors: int, own: int) -> None:
        self._block: list[Floats] = []
        self._size = regressors
        self._products = np.zeros((regressors + own, regressors + own))
        self._count = 0

    def add(self, regressors: Floats, values: Floats) -> None:
        """Add a message; values that were not finite are as in the middle of their range."""
        self._block.append(np.concatenate([regressors, np.nan_to_num(values)]))
        if len(self._block) == _BLOCK:
            self._flush()

    def _flush(self) -> None:
        if self._block:
            rows = np.array(self._block)
            self._products += rows.T @ rows
            self._count += len(rows)
            self._block = []

    def solved(self, ridge: float) -> tuple[Floats, Floats] | None:
        """Return coefficients, and what whitens residuals; None after fewer than 3 messages."""
        self._flush()
        n, size = self._count, self._size
        if n < 3:
            return None
        gram, cross = self._products[:size, :size], self._products[:size, size:]
        penalty = np.full(size, ridge * n)
        penalty[0] = 1e-9 * n
        coefficients = np.linalg.solve(gram + np.diag(penalty), cross)
        fitted = cross.T @ coefficients
        squares = self._products[size:, size:] - fitted - fitted.T
        squares += coefficients.T @ gram @ coefficients
        covariance = squares / max(n - size, n / 2)
        return np.ascontiguousarray(coefficients), _whitening(covariance)


def _whitening(covariance: Floats) -> Floats:
    """Return the ZCA-cor whitening: the inverse root of the correlation, by standard deviations."""
    spread = np.maximum(np.sqrt(np.maximum(np.diag(covariance), 0)), _LEAST_SPREAD)
    correlation = (1 - _SHRINK) * covariance / np.outer(spread, spread)
    np.fill_diagonal(correlation, 1.0)
    values, vectors = np.linalg.eigh((correlation + correlation.T) / 2)
    root = vectors / np.sqrt(np.maximum(values, _SHRINK / 2)) @ vectors.T
    return np.ascontiguousarray(root / spread)


class _Regression:
    """What was learnt about an item: coefficients (regressors, own), whitening (own, own)."""

    def __init__(self, coefficients: Floats, whitening: Floats) -> None:
        self.coefficients, self.whitening = coefficients, whitening

    def squares(self, regressors: Floats, values: Floats) -> Floats:
        """Return the squares of the whitened residuals; 0 for a value that is not there."""
        residual = values - regressors @ self.coefficients
        residual[np.isnan(residual)] = 0.0
        white = np.minimum(np.abs(self.whitening @ residual), CLIP)
        return np.asarray(white * white)


def _smoothed(before: NDArray[Any] | None, now: Floats, weight: float) -> Floats:
    return now if before is None else before + weight * (now - before)


class _Pair:
    """Recursive least squares from inputs to an output, and the running z-score of its residual."""

    def __init__(self, options: PairOptions, items: Sequence[str], places: Sequence[int]) -> None:
        self.output, self.items = options.output, items
        self.position, self.inputs = places[0], list(places[1:])
        self.input_lags, self.output_lags = options.input_lags, options.output_lags
        size = 1 + len(self.inputs) * options.input_lags + options.output_lags
        self.theta = np.zeros(size)
        self.variance = np.eye(size) * _START_VARIANCE
        self.mean, self.square, self.rows = 0.0, 1.0, 1.0
        self.past_inputs: list[list[float]] = []
        self.past_outputs: list[float] = []
        self.score = 0.0
        self._options = options

    @classmethod
    def new(cls, options: PairOptions, channels: Channels) -> _Pair:
        """Make a pair that has learnt nothing; raises ValueError where a variable is not known."""
        places = [channels.position(name) for name in (options.output, *options.inputs)]
        return cls(options, [channels.names[place][0] for place in places], places)

    def observe(self, held: Floats, config: ResidualOptions) -> bool:
        """Use all values held after a message of the output; return whether there is a score."""
        output = float(held[self.position])
        self.past_inputs = [held[self.inputs].tolist(), *self.past_inputs][: self.input_lags]
        ready = len(self.past_inputs) == self.input_lags
        ready = ready and len(self.past_outputs) == self.output_lags
        if ready:
            given = [1.0, *(v for values in self.past_inputs for v in values), *self.past_outputs]
            self._learn(np.array(given), output, config)
        self.past_outputs = [output, *self.past_outputs][: self.output_lags]
        return ready

    def _learn(self, given: Floats, output: float, config: ResidualOptions) -> None:
        error = output - float((self.theta * given).sum())
        spread = max(self.square**0.5, _LEAST_SPREAD)
        z = min(abs(error - self.mean) / spread, CLIP)
        self.score += config.smoothing * (z - self.score)
        if z > _CLIPPED:  # learnt only a little, so that a fault is not learnt as normal
            self.theta = self.theta + _LITTLE * self._gain(given, config)[0] * error * _CLIPPED / z
            return
        gain, projected = self._gain(given, config)
        self.theta = self.theta + gain * error
        variance = (self.variance - gain[:, None] * projected) / config.forget
        variance = (variance + variance.T) / 2
        trace = float(np.trace(variance))
        self.variance = variance if trace <= _MOST_TRACE else variance * (_MOST_TRACE / trace)
        weight = 1 / self.rows
        apart = error - self.mean
        self.mean += weight * apart
        self.square += weight * (apart * apart - self.square)
        self.rows = min(self.rows + 1, _MOST_ROWS)

    def _gain(self, given: Floats, config: ResidualOptions) -> tuple[Floats, Floats]:
        projected = (self.variance * given).sum(axis=1)
        return projected / (config.forget + float((projected * given).sum())), projected

    def for_next_mission(self) -> _Pair:
        """Return the pair as learnt, without messages."""
        pair = self.copy()
        pair.past_inputs, pair.past_outputs, pair.score = [], [], 0.0
        pair.rows = min(pair.rows, _LEARNT_ROWS)
        return pair

    def copy(self) -> _Pair:
        """Return a pair that learns on its own."""
        pair = _Pair(self._options, self.items, (self.position, *self.inputs))
        pair.resume(self.state())
        return pair

    def state(self) -> dict[str, Any]:
        """Return all that changes, as JSON."""
        return {
            "theta": self.theta.tolist(),
            "variance": self.variance.tolist(),
            "residual": [self.mean, self.square, self.rows, self.score],
            "inputs": self.past_inputs,
            "outputs": self.past_outputs,
        }

    def resume(self, state: Mapping[str, Any]) -> None:
        """Restore what ``state`` returned."""
        self.theta = as_floats(np.array(state["theta"]), self.theta.shape)
        self.variance = as_floats(np.array(state["variance"]), self.variance.shape)
        mean, square, rows, score = state["residual"]
        self.mean, self.square, self.score = as_number(mean), as_number(square), as_number(score)
        self.rows = min(as_number(rows, 1.0), _MOST_ROWS)
        size = (len(self.inputs),)
        inputs = [as_floats(np.array(values, float), size).tolist() for values in state["inputs"]]
        self.past_inputs = inputs[: self.input_lags]
        self.past_outputs = [as_number(value) for value in state["outputs"]][: self.output_lags]
