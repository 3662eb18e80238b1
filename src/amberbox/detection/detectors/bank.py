"""Bank of Kalman filters: named linear models of the robot, healthy and faulty, and how probable.

Models are matrices F, H, Q, R, in YAML or by a Python function of the time step. As an interacting
multiple model filter (Bar-Shalom, Li, Kirubarajan 2001) the bank follows changes between models; no
probability falls below a floor, so that long healthy operation locks no fault out. Values of
sensors are used as they arrive, together or one by one, at any distance in time.
"""

from __future__ import annotations

import ast
import importlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np

from amberbox.core.clock import NS
from amberbox.core.config import Finding
from amberbox.core.contracts import LearntState, MissionRows, Row, Score, ScoreReason
from amberbox.core.errors import AmberboxError, did_you_mean
from amberbox.core.options import option
from amberbox.detection.channels import Floats, add_count, as_floats, as_number, learn_channels
from amberbox.detection.kalman import BankState, LinearModels, correct_one, mix, predict, switching
from amberbox.detection.learnt_options import (
    only_value_errors,
    options_from_json,
    options_to_json,
)

Entries: TypeAlias = Sequence[Sequence[str]]
_FUNCTIONS: Mapping[str, Callable[[float], float]] = {
    "exp": math.exp, "sqrt": math.sqrt, "sin": math.sin, "cos": math.cos,
}  # fmt: skip
_LONGEST_TEXT = 200
_MOST_SIZE = 64
_TYPICAL_S = 0.1
_SHORTEST_S = 1e-5
_STEPS = 200
"""Time steps for which the matrices of a factory are kept, from 10 us to the gap."""
_MOST_NUMBERS = 4_000_000


@dataclass(frozen=True, slots=True)
class ModelOptions:
    """One model: its matrices row by row; an entry is a number, or a formula of the time step."""

    f: Entries = option(doc="from one state to the next, such as [[1, dt], [0, 1]]", aliases=("F",))
    h: Entries = option(doc="from the state to the sensors", aliases=("H",))
    q: Entries = option(doc="covariance of what disturbs the state during dt", aliases=("Q",))
    r: Entries = option(doc="covariance of the sensors' noise", aliases=("R",))
    masked: Sequence[str] = option(
        (), "sensors that this model does not believe; R is their spread"
    )


@dataclass(frozen=True, slots=True)
class BankOptions:
    """The sensors and the models."""

    sensors: Sequence[str] = option((), "the variables that are measured, ITEM.VARIABLE: rows of H")
    models: Mapping[str, ModelOptions] = option({}, "models by name")
    factory: str = option("", "instead of models: MODULE:FUNCTION, which makes them from dt")
    nominal: str = option("", "the model of the healthy robot; the first by default")
    start: Sequence[float] = option((), "the state at the start of a mission; zeros by default")
    start_variance: float = option(1000.0, "variance of each element of the state at the start")
    sojourn: float = option(100.0, "how long a model holds on average; .inf: for ever", unit="s")
    floor: float = option(1e-9, "the least probability of a model")
    gap: float = option(10.0, "a longer gap starts the filters again", unit="s")
    smoothing: float = option(0.2, "weight of the newest message in the innovation's score")

    def check(self) -> Iterator[Finding]:
        """Refuse matrices that do not fit, and values outside their ranges."""
        if bool(self.models) == bool(self.factory):
            yield "give 'models' or 'factory'"
        if not self.sensors:
            yield "sensors", "list at least one variable"
        if len(set(self.sensors)) < len(self.sensors):
            yield "sensors", "a sensor is there twice"
        if self.factory and not all(_names(self.factory)):
            yield "factory", "write MODULE:FUNCTION"
        yield from self._out_of_range()
        try:
            if self.models:
                _given(self)
        except (ValueError, ArithmeticError) as error:
            yield "models", str(error)

    def _out_of_range(self) -> Iterator[Finding]:
        for key in ("sojourn", "start_variance", "gap"):
            if not getattr(self, key) > 0 or (key != "sojourn" and math.isinf(getattr(self, key))):
                yield key, "must lie above 0"
        if not 0 <= self.floor < 0.1:
            yield "floor", "must lie between 0 and 0.1"
        if not 0 < self.smoothing <= 1:
            yield "smoothing", "must lie above 0, and be 1 at most"


Config = BankOptions
SAMPLE = """\
sensors: [arm.angle]
models:
  moves: {F: [[1, dt], [0, 1]], H: [[1, 0]], Q: [[1e-6, 0], [0, 0.01 * dt]], R: [[1e-4]]}
  blocked: {F: [[1, 0], [0, 0]], H: [[1, 0]], Q: [[1e-6, 0], [0, 1e-6]], R: [[1e-4]]}
"""


class Detector:
    """Scores how improbable the healthy model is, and how little the best model explains."""

    version = 1

    def __init__(self, config: BankOptions) -> None:
        self.config = config
        self.counts: dict[str, int] = {}
        self._make: Callable[[float], _Models] | None = None
        self._table: _Table | None = None
        self._set_up([], 0)

    def _set_up(self, sensors: Sequence[tuple[str, str]], messages: int) -> None:
        """Set the item and variable of each sensor, and how many nominal messages had one."""
        self._sensors, self._messages = list(sensors), messages
        self._items: dict[str, list[tuple[str, int]]] = {}
        for place, (item, variable) in enumerate(sensors):
            self._items.setdefault(item, []).append((variable, place))
        self.begin(0)

    def fit(self, missions: Sequence[MissionRows]) -> None:
        """Check that the models can be made, and that nominal missions have the sensors.

        What a factory makes is kept as matrices, so that no model file needs its code.
        """
        self._make = self._table = None
        self._set_up([], 0)
        if not self.config.sensors:
            return
        channels = learn_channels(missions, {}, self.config.sensors, self.config.sensors)
        sensors = [channels.names[channels.position(name)] for name in self.config.sensors]
        items = {item for item, _ in sensors}
        messages = sum(row.item in items for mission in missions for row in mission)
        self._load()
        self._set_up(sensors, messages)

    def _load(self) -> Callable[[float], _Models]:
        if self._make is None:
            try:
                if self._table is None and self.config.factory:
                    self._table = _tabled(self.config, _from_factory(self.config))
                self._make = _given(self.config) if self._table is None else self._table.at
            except (ValueError, ArithmeticError) as error:
                raise AmberboxError(f"bank: {error}", "see 'amberbox plugins bank'") from error
        return self._make

    def begin(self, at_ns: int) -> None:
        """Forget the messages before a mission."""
        self._state: BankState | None = None
        self._last_ns = 0
        self._innovation: float | None = None
        self._worst = 0
        self._last_names: tuple[str, ...] = ()

    def observe(self, row: Row) -> Sequence[Score]:
        """Use the sensors' values in a message."""
        sensors = self._items.get(row.item)
        if sensors is None:
            return ()
        values = [math.nan] * len(self._sensors)
        for variable, place in sensors:
            values[place] = row.values.get(variable, math.nan)
        read = sum(map(math.isfinite, values))
        if read < len(sensors):
            add_count(
                self.counts, "values of sensors that are missing or not finite", len(sensors) - read
            )
        if read == 0:
            return ()
        try:
            return self._step(row.at_ns, values)
        except (ArithmeticError, ValueError, np.linalg.LinAlgError):
            add_count(self.counts, "restarts of the filters after a step that failed")
            self._state = None
            return ()

    def _step(self, at_ns: int, z: Sequence[float]) -> Sequence[Score]:
        dt_s = (at_ns - self._last_ns) / NS
        if self._state is not None and dt_s > self.config.gap:
            add_count(self.counts, "restarts of the filters after a gap")
            self._state = None
        self._last_ns = at_ns
        make = self._load()
        models = make(dt_s if self._state is not None and dt_s > 0 else _TYPICAL_S)
        state = self._state or self._start(models)
        with np.errstate(all="ignore"):
            if self._state is not None and dt_s > 0:
                if math.isfinite(self.config.sojourn):
                    stay = math.exp(-dt_s / self.config.sojourn)
                    mix(state, _switching(len(models.names), stay))
                predict(state, models.linear)
            result = correct_one(state, models.linear, z, self.config.floor)
            size = sum(result.weights) + np.vdot(state.x, state.x) + np.vdot(state.p, state.p)
        if not math.isfinite(size):
            raise ArithmeticError
        self._state, self._last_names = state, models.names
        nominal = max(result.weights[models.nominal], 1e-300)
        scores = [Score(at_ns, "model", max(-math.log(nominal), 0.0))]
        used = [place for place, is_used in enumerate(result.used) if is_used]
        if used:
            white, apart = result.white, result.innovations
            now = math.sqrt(sum(white[place] * white[place] for place in used) / len(used))
            before = now if self._innovation is None else self._innovation
            self._innovation = before + self.config.smoothing * (now - before)
            self._worst = max(used, key=lambda place: abs(apart[place]))
            scores.append(Score(at_ns, "innovation", self._innovation))
        return scores

    def _start(self, models: _Models) -> BankState:
        count, size = len(models.names), models.linear.f.shape[-1]
        start = np.array(self.config.start or np.zeros(size), float)
        variance = np.eye(size) * self.config.start_variance
        return BankState.at(start, variance, np.full(count, 1 / count))

    def tick(self, now_ns: int) -> Sequence[Score]:
        """Return no scores: silence is for others to see."""
        return ()

    def explain(self, series: str) -> ScoreReason:
        """Return the most probable model, or the sensor that no model explains."""
        config = self.config
        if series == "innovation" or self._state is None:
            item, variable = self._sensors[self._worst]
            size = self._innovation or 0.0
            text = f"no model explains {item}.{variable}: {size:.3g} standard deviations"
            return ScoreReason("no_model", item, variable, text)
        weights = dict(zip(self._last_names, self._state.weights[0].tolist(), strict=True))
        ranked = sorted(weights.items(), key=lambda entry: -entry[1])
        nominal = config.nominal or self._last_names[0]
        name, weight = next((entry for entry in ranked if entry[0] != nominal), ranked[0])
        masked = config.models[name].masked if name in config.models else ()
        item, variable = self._sensors[config.sensors.index(masked[0]) if masked else 0]
        text = f"the model '{name}' has the probability {weight:.3g}"
        return ScoreReason(name, item, variable if masked else "", text, tuple(ranked))

    def learnt(self) -> LearntState:
        """Return item and variable of each sensor, and how many nominal messages had one."""
        sensors = [list(sensor) for sensor in self._sensors]
        values = {
            "options": options_to_json(self.config), "messages": self._messages, "sensors": sensors,
        }  # fmt: skip
        if self._table is None:
            return LearntState(values)
        linear = self._table.linear
        values |= {"names": list(self._table.names), "nominal": self._table.nominal}
        arrays = {"steps": self._table.steps_s, "masked": linear.masked}
        arrays |= {"f": linear.f, "h": linear.h, "q": linear.q, "r": linear.r}
        return LearntState(values, arrays)

    @only_value_errors()
    def restore(self, state: LearntState) -> None:
        """Restore what was learnt; no code of a factory runs, whose matrices were kept.

        Earlier files have none: there the options of this detector have to name the factory, too.
        """
        config = options_from_json(Config, state.values["options"])
        table = _restored(config, state) if "steps" in state.arrays else None
        if config.factory and table is None and config.factory != self.config.factory:
            raise ValueError(
                f"its models come from Python code, '{config.factory}': "
                "only a robot whose own options name this factory runs it"
            )
        self.config, self._make, self._table = config, None, table
        sensors = [(str(item), str(variable)) for item, variable in state.values["sensors"]]
        if tuple(f"{item}.{variable}" for item, variable in sensors) != tuple(self.config.sensors):
            raise ValueError("learnt with other sensors")
        if sensors:
            self._load()
        self._set_up(sensors, int(state.values["messages"]))

    def snapshot(self) -> dict[str, Any]:
        """Return the filters."""
        state = self._state
        return {
            "last_ns": self._last_ns,
            "innovation": self._innovation,
            "worst": self._worst,
            "state": state and [state.x.tolist(), state.p.tolist(), state.weights.tolist()],
        }

    @only_value_errors()
    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Continue a mission."""
        self.begin(0)
        self._last_ns, self._worst = int(snapshot["last_ns"]), int(snapshot["worst"])
        innovation = snapshot["innovation"]
        self._innovation = None if innovation is None else as_number(innovation, 0.0)
        if snapshot["state"] is None:
            return
        models = self._load()(_TYPICAL_S)
        count, size = len(models.names), models.linear.f.shape[-1]
        x, p, weights = (np.array(part, float) for part in snapshot["state"])
        self._last_names = models.names
        self._state = BankState(
            as_floats(x, (1, count, size)),
            as_floats(p, (1, count, size, size)),
            as_floats(weights, (1, count)),
        )


@dataclass(frozen=True, slots=True)
class _Models:
    names: tuple[str, ...]
    nominal: int
    linear: LinearModels


@lru_cache(maxsize=64)
def _switching(models: int, stay: float) -> Floats:
    return switching(models, stay)


def _names(factory: str) -> tuple[str, str]:
    module, _, function = factory.partition(":")
    return module, function


def _from_factory(config: BankOptions) -> Callable[[float], _Models]:
    """Return the models that a Python function makes; raises ValueError if there is none."""
    module, name = _names(config.factory)
    try:
        function = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"the factory '{config.factory}' is not there: {error}") from error

    def make(dt_s: float) -> _Models:
        try:
            found = function(dt_s)
        except Exception as error:  # another's code may raise anything
            raise ValueError(f"'{config.factory}' fails for dt={dt_s:g}: {error!r}") from error
        try:
            parts = [[np.array(given[key], float) for key in "FHQR"] for given in found.values()]
            masked = [given.get("masked", ()) for given in found.values()]
        except (TypeError, AttributeError, KeyError) as error:
            what = f"'{config.factory}' must return models by name, each a mapping of F, H, Q, R"
            raise ValueError(what) from error
        return _stacked(config, tuple(map(str, found)), parts, masked)

    _check(config, make(_TYPICAL_S))
    return make


@dataclass(frozen=True, slots=True)
class _Table:
    """Models of a factory for growing time steps; between them they are interpolated.

    The arrays of ``linear`` have the step as their first axis, of length 1 where nothing depends on
    it. Between two covariances lies a covariance.
    """

    steps_s: Floats
    names: tuple[str, ...]
    nominal: int
    linear: LinearModels

    def at(self, dt_s: float) -> _Models:
        """Return the models for a time step."""
        place = int(np.searchsorted(self.steps_s, dt_s)) - 1
        low = min(max(place, 0), len(self.steps_s) - 2)
        start_s, end_s = self.steps_s[low], self.steps_s[low + 1]
        share = min(max((dt_s - start_s) / (end_s - start_s), 0.0), 1.0)
        f, h, q, r = (_between(stack, low, share) for stack in _stacks(self.linear))
        return _Models(self.names, self.nominal, LinearModels(f, q, h, r, self.linear.masked))


def _stacks(linear: LinearModels) -> tuple[Floats, Floats, Floats, Floats]:
    return linear.f, linear.h, linear.q, linear.r


def _between(stack: Floats, low: int, share: float) -> Floats:
    first: Floats = stack[0] if len(stack) == 1 else stack[low]
    return first if len(stack) == 1 else first + share * (stack[low + 1] - first)


def _tabled(config: BankOptions, make: Callable[[float], _Models]) -> _Table:
    """Return what a factory makes for all time steps; raises ValueError if it cannot be kept."""
    longest_s = max(config.gap, 10 * _SHORTEST_S)
    steps_s = np.geomspace(_SHORTEST_S, longest_s, _STEPS)
    made = [make(float(dt_s)) for dt_s in steps_s]
    first = made[0]
    if any(one.names != first.names for one in made):
        raise ValueError(f"'{config.factory}' must return the same models for each time step")
    stacks = []
    for key, parts in zip("FHQR", zip(*(_stacks(one.linear) for one in made), strict=True),
                          strict=True):  # fmt: skip
        stack = np.stack(parts)
        stacks.append(stack[:1] if (stack == stack[0]).all() else stack)
        if sum(one.size for one in stacks) > _MOST_NUMBERS:
            raise ValueError(f"the matrices are too large to be kept, up to {key}")
    f, h, q, r = stacks
    linear = LinearModels(f, q, h, r, first.linear.masked)
    table = _Table(steps_s, first.names, first.nominal, linear)
    _check_table(config, table)
    return table


def _restored(config: BankOptions, state: LearntState) -> _Table:
    """Return the table of a model file; raises ValueError, KeyError or TypeError if it is wrong."""
    names = tuple(str(name) for name in state.values["names"])
    count, sensors = len(names), len(config.sensors)
    steps_s = as_floats(state.arrays["steps"], (_STEPS,))
    if not (np.diff(steps_s) > 0).all() or not steps_s[0] > 0 or not 0 < count <= _MOST_SIZE:
        raise ValueError("time steps that do not grow, or no models")
    size = state.arrays["f"].shape[-1]
    shapes = {"f": (size, size), "h": (sensors, size), "q": (size, size), "r": (sensors, sensors)}
    found = {}
    for key, shape in shapes.items():
        steps = len(state.arrays[key])
        if steps not in (1, _STEPS):
            raise ValueError(f"{key} has {steps} time steps")
        found[key] = as_floats(state.arrays[key], (steps, count, *shape))
    masked = np.ascontiguousarray(state.arrays["masked"], bool)
    nominal = int(state.values["nominal"])
    if masked.shape != (count, sensors) or not 0 <= nominal < count:
        raise ValueError("masks that do not fit the models")
    linear = LinearModels(found["f"], found["q"], found["h"], found["r"], masked)
    table = _Table(steps_s, names, nominal, linear)
    _check_table(config, table)
    return table


def _check_table(config: BankOptions, table: _Table) -> None:
    """Raise ValueError where the models for a time step are wrong."""
    varies = any(len(stack) > 1 for stack in _stacks(table.linear))
    for dt_s in table.steps_s if varies else table.steps_s[:1]:
        _check(config, table.at(float(dt_s)))


def _given(config: BankOptions) -> Callable[[float], _Models]:
    """Return the models of the options; raises ValueError where an entry cannot be read."""
    read = [
        [_Matrix(f"{name}.{key}", getattr(model, key.lower())) for key in "FHQR"]
        for name, model in config.models.items()
    ]
    parts = [[matrix.at(_TYPICAL_S) for matrix in model] for model in read]
    masked = [model.masked for model in config.models.values()]
    once = _stacked(config, tuple(config.models), parts, masked)
    _check(config, once)
    stacks = once.linear.f, once.linear.h, once.linear.q, once.linear.r
    formulas = [
        (which, (number, *place), formula)
        for number, model in enumerate(read)
        for which, matrix in enumerate(model)
        for place, formula in matrix.formulas
    ]

    varies = {which for which, _, _ in formulas}

    @lru_cache(maxsize=64)
    def make(dt_s: float) -> _Models:
        made = [stack.copy() if i in varies else stack for i, stack in enumerate(stacks)]
        for which, place, formula in formulas:
            made[which][place] = formula(dt_s)
        f, h, q, r = made
        return _Models(once.names, once.nominal, LinearModels(f, q, h, r, once.linear.masked))

    return make if formulas else lambda dt_s: once


def _stacked(
    config: BankOptions,
    names: tuple[str, ...],
    parts: Sequence[Sequence[Floats]],
    masked: Sequence[Sequence[str]],
) -> _Models:
    """Return F, H, Q, R of each model as arrays; raises ValueError if their sizes do not fit."""
    if not names:
        raise ValueError("there is no model")
    sensors, size = len(config.sensors), len(parts[0][0])
    shapes = ((size, size), (sensors, size), (size, size), (sensors, sensors))
    for name, model, hidden in zip(names, parts, masked, strict=True):
        for key, matrix, shape in zip("FHQR", model, shapes, strict=True):
            if matrix.shape != shape:
                raise ValueError(f"{name}.{key} must have {shape[0]} rows of {shape[1]} numbers")
        for sensor in hidden:
            if sensor not in config.sensors:
                near = did_you_mean(sensor, config.sensors)
                raise ValueError(f"{name}.masked: '{sensor}' is no sensor of the bank{near}")
    if config.nominal and config.nominal not in names:
        raise ValueError(
            f"no model is named '{config.nominal}'{did_you_mean(config.nominal, names)}"
        )
    f, h, q, r = (np.stack([model[k] for model in parts]) for k in range(4))
    flags = np.array([[sensor in hidden for sensor in config.sensors] for hidden in masked])
    nominal = names.index(config.nominal) if config.nominal else 0
    return _Models(names, nominal, LinearModels(f, q, h, r, flags))


def _check(config: BankOptions, models: _Models) -> None:
    """Raise ValueError where a matrix is not finite, or Q or R is no covariance."""
    linear = models.linear
    for number, name in enumerate(models.names):
        for key, stack in (("F", linear.f), ("H", linear.h), ("Q", linear.q), ("R", linear.r)):
            if not np.isfinite(stack[number]).all():
                raise ValueError(f"{name}.{key} has an entry that is not finite")
        if not _is_covariance(linear.r[number], definite=True):
            raise ValueError(f"{name}.R is no covariance: symmetric, positive definite")
        if not _is_covariance(linear.q[number], definite=False):
            raise ValueError(f"{name}.Q is no covariance: symmetric, not negative")
    if config.start and len(config.start) != linear.f.shape[-1]:
        raise ValueError(f"start must have {linear.f.shape[-1]} numbers, as the state has")


def _is_covariance(matrix: Floats, definite: bool) -> bool:
    if not np.allclose(matrix, matrix.T):
        return False
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    return (
        smallest > 0 if definite else smallest >= -1e-12 * max(float(np.abs(matrix).max()), 1e-300)
    )


class _Matrix:
    """A matrix some of whose entries are formulas of the time step."""

    def __init__(self, name: str, entries: Entries) -> None:
        if not entries or len(entries) > _MOST_SIZE or len({len(row) for row in entries}) > 1:
            raise ValueError(f"{name} must have 1 to {_MOST_SIZE} rows of the same length")
        self._fixed = np.zeros((len(entries), len(entries[0])))
        self.formulas: list[tuple[tuple[int, int], Formula]] = []
        for i, row in enumerate(entries):
            for j, entry in enumerate(row):
                try:
                    self._fixed[i, j] = float(entry)
                except ValueError:
                    self.formulas.append(((i, j), _formula(name, str(entry))))

    def at(self, dt_s: float) -> Floats:
        """Return the matrix for a time step in seconds."""
        matrix = self._fixed.copy()
        for place, formula in self.formulas:
            matrix[place] = formula(dt_s)
        return matrix


Formula: TypeAlias = Callable[[float], float]


def _formula(name: str, text: str) -> Formula:
    """Return a formula of ``dt``: + - * / **, exp, sqrt, sin, cos; raises ValueError."""
    try:
        if len(text) > _LONGEST_TEXT:
            raise ValueError(f"longer than {_LONGEST_TEXT} characters")
        return _term(ast.parse(text.strip(), mode="eval").body)
    except (ValueError, SyntaxError) as error:
        allowed = "numbers, dt, + - * / **, exp, sqrt, sin, cos"
        raise ValueError(f"{name}: '{text[:40]}' is no formula of {allowed}") from error


def _term(node: ast.expr) -> Formula:
    match node:
        case ast.Constant(value=int() | float() as value):
            number = float(value)
            return lambda dt: number
        case ast.Name(id="dt"):
            return lambda dt: dt
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            inner = _term(operand)
            return lambda dt: -inner(dt)
        case ast.Call(func=ast.Name(id=called), args=[argument], keywords=[]) if (
            called in _FUNCTIONS
        ):
            function, inner = _FUNCTIONS[called], _term(argument)
            return lambda dt: function(inner(dt))
        case ast.BinOp(left=left, op=op, right=right):
            return _operation(op, _term(left), _term(right))
    raise ValueError("not allowed here")


def _operation(op: ast.operator, left: Formula, right: Formula) -> Formula:
    match op:
        case ast.Add():
            return lambda dt: left(dt) + right(dt)
        case ast.Sub():
            return lambda dt: left(dt) - right(dt)
        case ast.Mult():
            return lambda dt: left(dt) * right(dt)
        case ast.Div():
            return lambda dt: left(dt) / right(dt)
        case ast.Pow():
            return lambda dt: math.pow(left(dt), right(dt))
    raise ValueError("not allowed here")
