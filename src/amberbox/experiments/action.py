"""Declared actions: what a robot can do, read from ``actions/*.yaml`` of its folder and checked.

A file holds declarations by name. Keys that all actions have are those of ``ActionOptions``, the
rest are options of the action's kind (``experiments/actions/KIND.py``).
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal, NoReturn, Protocol, TypeAlias

import msgspec
from msgspec import Meta

from amberbox.core.command import Risk
from amberbox.core.config import Finding, build, field_keys
from amberbox.core.errors import (
    AmberboxError,
    ConfigurationError,
    Problem,
    UsageError,
    did_you_mean,
    nearest_word,
)
from amberbox.core.options import option
from amberbox.core.plugins import Plugin, find
from amberbox.core.safe_text import one_line
from amberbox.core.yaml_nodes import Node, load_yaml

FOLDER = "actions"
ACTIONS = "amberbox.experiments.actions"
DEFINES = ("Config", "run")

MOST_ACTIONS = 200
MOST_PARAMETERS = 50
MOST_CHOICES = 100
LONGEST_TEXT = 1000  # characters of a parameter or a description
PARAMETERS_BYTES = 16_384  # JSON text of the values of one command
LONGEST_TIMEOUT_S = 3600.0
LONGEST_STOP_S = 30.0
_LONGEST_NUMBER = 40  # characters
_INT_64 = 2**63
_ACTION_NAME = re.compile(r"[a-z][a-z0-9_-]{0,63}")
_PARAMETER_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")

_YES_NO = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}

Value: TypeAlias = bool | int | float | str
_Text: TypeAlias = Annotated[str, Meta(max_length=LONGEST_TEXT)]


@dataclass(frozen=True)
class ParameterOptions:
    """A parameter of an action: its type and the values it may have."""

    type: Literal["", "bool", "int", "float", "string"] = option(
        "", "`bool`, `int`, `float` or `string`; else string if choices are text, or float"
    )
    unit: str = option("", "unit of its numbers, for people")
    min: float | None = option(None, "smallest number; `moves` needs it for every number")
    max: float | None = option(None, "largest number; `moves` needs it for every number")
    choices: Sequence[Any] = option((), "the values it may have; others are refused")
    default: Any = option(None, "value where none is given; without it the parameter is required")
    max_length: int = option(100, "most characters of a string")
    description: str = option("", "what it is, for people")

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong with the values."""
        numeric = self.kind in ("int", "float")
        for key in ("min", "max"):
            limit = getattr(self, key)
            if limit is not None and not numeric:
                yield key, f"a {self.kind} has no limits"
            elif limit is not None and not math.isfinite(limit):
                yield key, "must be finite"
        if self.min is not None and self.max is not None and self.min > self.max:
            yield "min", f"{self.min:g} is above max, {self.max:g}"
        if not 0 < self.max_length <= LONGEST_TEXT:
            yield "max_length", f"must be from 1 to {LONGEST_TEXT}"
        if len(self.choices) > MOST_CHOICES:
            yield "choices", f"are more than {MOST_CHOICES}"
        for key in ("unit", "description"):
            yield from _unfit(key, getattr(self, key))
        one = replace(self, type=self.kind, choices=())
        for choice in self.choices:
            yield from (("choices", what) for what in _refused(one, choice))
        if self.default is not None:
            yield from (("default", what) for what in _refused(self, self.default))

    @property
    def kind(self) -> Literal["bool", "int", "float", "string"]:
        """Return its type."""
        if self.type:
            return self.type
        is_text = any(isinstance(choice, str) for choice in self.choices)
        return "string" if is_text else "float"

    def accept(self, value: object) -> Value:
        """Return a value in the parameter's type; raises ValueError with a sentence."""
        accepted = _ACCEPT[self.kind](self, value)
        if self.choices and accepted not in self.choices:
            listed = ", ".join(str(choice) for choice in self.choices)
            near = did_you_mean(value, self.choices) if isinstance(value, str) else ""
            raise ValueError(f"{_shown(value)} is none of {listed}{near}")
        return accepted

    def _bool(self, value: object) -> Value:
        if not isinstance(value, bool):
            raise ValueError(f"{_shown(value)} is neither true nor false")
        return value

    def _text(self, value: object) -> Value:
        if not isinstance(value, str):
            raise ValueError(f"{_shown(value)} is no text")
        if len(value) > self.max_length:
            raise ValueError(f"has {len(value)} characters; at most {self.max_length} are allowed")
        if not value.isprintable():
            raise ValueError(f"{_shown(value)} has characters that are not printed")
        return value

    def _int(self, value: object) -> Value:
        number = self._number(value)
        if number != number // 1:
            raise ValueError(f"{_shown(value)} is not whole")
        if not -_INT_64 <= number < _INT_64:
            raise ValueError(f"{_shown(value)} is too large")
        return int(number)

    def _float(self, value: object) -> Value:
        try:
            return float(self._number(value))
        except OverflowError:
            raise ValueError(f"{_shown(value)} is too large") from None

    def _number(self, value: object) -> int | float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{_shown(value)} is no number")
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"{_shown(value)} is not finite")
        unit = f" {self.unit}" if self.unit else ""
        if self.min is not None and value < self.min:
            raise ValueError(f"{_shown(value)} is below the least value, {self.min:g}{unit}")
        if self.max is not None and value > self.max:
            raise ValueError(f"{_shown(value)} is above the largest value, {self.max:g}{unit}")
        return value


_ACCEPT = {
    "bool": ParameterOptions._bool,
    "int": ParameterOptions._int,
    "float": ParameterOptions._float,
    "string": ParameterOptions._text,
}


def _refused(parameter: ParameterOptions, value: object) -> Iterator[str]:
    try:
        parameter.accept(value)
    except ValueError as error:
        yield str(error)


def _unfit(key: str, text: str) -> Iterator[tuple[str, str]]:
    """Yield why a text for people cannot be announced."""
    if len(text) > LONGEST_TEXT:
        yield key, f"has more than {LONGEST_TEXT} characters"
    if not " ".join(text.split()).isprintable():
        yield key, "has characters that are not printed"


def _shown(value: object) -> str:
    """Return a value that anybody may have sent as a short text for a message."""
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 100:
        return "a number of more than 30 digits"
    text = one_line(value if isinstance(value, str) else repr(value))
    text = text if len(text) <= 40 else f"{text[:40]}..."
    return f"'{text}'" if isinstance(value, str) else text


@dataclass(frozen=True)
class ActionOptions:
    """What every action declares, beside the options of its kind."""

    kind: str = option(doc="how it is carried out; 'amberbox plugins --kind action' lists them")
    risk: Risk = option(doc="`state`: changes something; `moves`: the robot or a part of it moves")
    description: str = option("", "what it does, for people")
    parameters: Mapping[str, ParameterOptions] = option({}, "parameters by name")
    timeout: float = option(30.0, "longest run; then it is stopped and has failed", unit="s")
    stop_timeout: float = option(5.0, "after so long a safe stop is given up", unit="s")

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong with the values."""
        if self.risk == "record":
            hint = "write state or moves, which a person has to sign"
            yield "risk", "'record' is for what only concerns the record", hint
        for key, most in (("timeout", LONGEST_TIMEOUT_S), ("stop_timeout", LONGEST_STOP_S)):
            if not 0 < getattr(self, key) <= most:
                yield key, f"must be above 0 and at most {most:g} s"
        if len(self.parameters) > MOST_PARAMETERS:
            yield "parameters", f"are more than {MOST_PARAMETERS}"
        yield from _unfit("description", self.description)


@dataclass(frozen=True)
class DeclaredAction:
    """An action that a robot can do; ``config`` are the options of its kind."""

    name: str
    options: ActionOptions
    config: Any
    module: ModuleType
    file: str
    line: int

    @property
    def parameters(self) -> Mapping[str, ParameterOptions]:
        """Return the parameters by name."""
        return self.options.parameters

    def has(self, function: Literal["safe_stop", "simulated"]) -> bool:
        """Return whether its kind has this function, and the declaration the option of its name."""
        return _has(self.module, self.config, function)

    def announced(self) -> dict[str, Any]:
        """Return what a server may know of it, as JSON: nothing of how it is carried out."""
        return {
            "name": self.name,
            "description": self.options.description,
            "risk": self.options.risk,
            "timeout_s": self.options.timeout,
            "simulated": self.has("simulated"),
            "parameters": {
                name: {
                    "type": parameter.kind,
                    "unit": parameter.unit,
                    "min": parameter.min,
                    "max": parameter.max,
                    "choices": list(parameter.choices),
                    "default": parameter.default,
                    "max_length": parameter.max_length if parameter.kind == "string" else None,
                    "description": parameter.description,
                }
                for name, parameter in self.parameters.items()
            },
        }


def _has(module: ModuleType, config: Any, function: str) -> bool:
    given = getattr(config, function, True)
    return hasattr(module, function) and bool(given)


def read_actions(folder: Path) -> tuple[dict[str, DeclaredAction], list[Problem]]:
    """Read all declared actions of a robot folder.

    Returns those without an error by name, and all problems. Opens no device and runs no code of
    the folder.
    """
    problems: list[Problem] = []
    nodes: dict[str, Node] = {}
    place = folder / FOLDER
    for path in sorted([*place.glob("*.yaml"), *place.glob("*.yml")]):
        root = None if path.name.startswith(".") else load_yaml(path, problems)
        if root is None or root.value is None:
            continue
        if root.mapping is None:
            what = f"expected actions by name (name: ...), got {root.kind}"
            problems.append(root.problem("file", what))
        for name, node in (root.mapping or {}).items():
            if name in nodes:
                first = nodes[name]
                what = f"this action is declared already, in {first.file}:{first.line}"
                problems.append(node.problem(name, what))
            else:
                nodes[name] = node
    if len(nodes) > MOST_ACTIONS:
        what = f"declares {len(nodes)} actions; at most {MOST_ACTIONS} are allowed"
        problems.append(Problem(str(place), 1, "folder", what))
        nodes = {}
    plugins = find(ACTIONS, defines=DEFINES) if nodes else {}
    found: dict[str, DeclaredAction] = {}
    for name, node in nodes.items():
        wrong: list[Problem] = []
        action = _declared(name, node, folder, plugins, wrong)
        problems += wrong
        found |= {} if action is None else {name: action}
    problems.sort(key=lambda problem: (problem.file, problem.line))
    return found, problems


def _declared(
    name: str, node: Node, folder: Path, plugins: Mapping[str, Plugin], problems: list[Problem]
) -> DeclaredAction | None:
    if not _ACTION_NAME.fullmatch(name):
        hint = "a-z 0-9 _ - and a letter first; names with a dot are those of Amberbox itself"
        problems.append(node.problem(name or "action", "cannot be the name of an action", hint))
    if node.mapping is None:
        what = f"expected a mapping (kind: ..., risk: ...), got {node.kind}"
        problems.append(node.problem(name, what))
        return None
    module = _module(name, node.mapping.get("kind"), plugins, problems)
    common, special = _divided(node, node.mapping, module)
    options = build(ActionOptions, common, problems, name)
    config = build(module.Config, special, problems, name) if module else None
    if options is not None:
        _check_parameter_names(name, node, options, problems)
    if options is None or module is None or config is None:
        return None
    hook = getattr(config, "in_folder", None)
    config = config if hook is None else hook(folder)
    for finding in _combined(options, module, config):
        key, *texts = ("", finding) if isinstance(finding, str) else finding
        at = node.mapping.get(key, node)
        problems.append(at.problem(f"{name}.{key}" if key else name, *texts))
    if any(problem.is_error for problem in problems):
        return None
    return DeclaredAction(name, options, config, module, node.file, node.line)


def _module(
    name: str, kind: Node | None, plugins: Mapping[str, Plugin], problems: list[Problem]
) -> ModuleType | None:
    """Return the plugin of a kind; None, and a problem, if there is none."""
    if kind is None or not kind.text:
        return None  # the missing key is reported with the others
    where = f"{name}.kind"
    if kind.text not in plugins:
        what = f"there is no kind of action '{kind.text}'{did_you_mean(kind.text, plugins)}"
        problems.append(kind.problem(where, what, f"known: {', '.join(plugins)}"))
        return None
    try:
        return plugins[kind.text].load()
    except AmberboxError as error:
        problems.append(kind.problem(where, error.what, error.hint))
    except Exception as error:  # a plugin of another package may fail in any way
        what = f"'{kind.text}' cannot be loaded: {type(error).__name__}: {error}"
        problems.append(kind.problem(where, what))
    return None


def _divided(
    node: Node, entries: Mapping[str, Node], module: ModuleType | None
) -> tuple[Node, Node]:
    """Return the keys that all actions have, and those of the kind.

    A misspelt key goes where the nearest known one belongs, so that its message can name it.
    """
    own, kinds = _keys(ActionOptions), _keys(module.Config) if module else frozenset()
    common: dict[str, Node] = {}
    special: dict[str, Node] = {}
    for key, value in entries.items():
        near = key if key in own | kinds else nearest_word(key, own | kinds)
        if near in own:
            common[key] = value
        if near in kinds or near is None:
            special[key] = value
    return replace(node, value=common), replace(node, value=special)


def _keys(cls: type[Any]) -> frozenset[str]:
    return frozenset(key for field in dataclasses.fields(cls) for key in field_keys(field))


def _check_parameter_names(
    name: str, node: Node, options: ActionOptions, problems: list[Problem]
) -> None:
    declared = (node.mapping or {}).get("parameters")
    for key, at in ((declared and declared.mapping) or {}).items():
        where = f"{name}.parameters.{key}"
        if not _PARAMETER_NAME.fullmatch(key):
            hint = "a-z 0-9 _ and a letter first"
            problems.append(at.problem(where, "cannot be the name of a parameter", hint))
        parameter = options.parameters[key]
        is_open = parameter.kind in ("int", "float") and not parameter.choices
        for limit in ("min", "max"):
            if is_open and options.risk == "moves" and getattr(parameter, limit) is None:
                what = f"has no {limit}: what moves needs limits for every number"
                problems.append(at.problem(where, what))


def _combined(options: ActionOptions, module: ModuleType, config: Any) -> Iterator[Finding]:
    """Yield what is wrong with the common options and those of the kind together."""
    if options.risk == "moves" and not _has(module, config, "safe_stop"):
        hint = "say how the robot is stopped, or choose a kind that can"
        yield "risk", "an action that moves something needs a safe_stop", hint
    judge = getattr(module, "problems", None)
    if judge is not None:
        yield from judge(config, tuple(options.parameters))


def load_action(folder: Path, name: str) -> DeclaredAction:
    """Return one action of a robot folder.

    Raises UsageError if it is not declared, ConfigurationError if its declaration is wrong.
    """
    found, problems = read_actions(folder)
    if name in found:
        return found[name]
    ours = [p for p in problems if p.is_error and (p.where == name or _is_below(p.where, name))]
    if ours:
        raise ConfigurationError(ours)
    what = f"this robot has no action '{one_line(name)[:64]}'{did_you_mean(name, found)}"
    raise UsageError(what, f"declared: {', '.join(found)}" if found else f"see {FOLDER}/*.yaml")


def _is_below(where: str, name: str) -> bool:
    return where.startswith(f"{name}.")


def announcement(
    folder: Path,
    recovers: Mapping[str, Sequence[str]] | None = None,
    most_bytes: int | None = None,
) -> str:
    """Return all actions of a folder without errors, for servers, as JSON text.

    It holds names, descriptions, risks, timeouts and parameters with limits; no addresses, no code.
    ``recovers`` are the causes (components, failure modes) against which an action may help.
    Actions that do not fit into ``most_bytes`` are left out; ``left_out`` counts them.
    """
    found, _ = read_actions(folder)
    actions, size, left_out = [], _ANNOUNCEMENT_BYTES, 0
    for name in sorted(found):
        action = found[name].announced() | {"recovers": list((recovers or {}).get(name, ()))}
        more = len(_json(action).encode()) + 2
        if most_bytes is not None and size + more > most_bytes:
            left_out += 1
        else:
            actions.append(action)
            size += more
    why = {"left_out": left_out, "reason": f"an announcement has at most {most_bytes} bytes"}
    return _json({"actions": actions, **(why if left_out else {})})


# Of an announcement without actions
_ANNOUNCEMENT_BYTES = 200


def _json(value: Mapping[str, Any]) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


@dataclass(frozen=True)
class AnnouncedAction:
    """What a server knows of an action of a robot.

    ``recovers`` names failure modes that it is a remedy of, as the robot says.
    """

    name: str
    risk: Risk
    description: str = ""
    timeout_s: float = 30.0
    simulated: bool = False
    parameters: Mapping[str, ParameterOptions] = field(default_factory=dict)
    recovers: Sequence[str] = ()


class _ParameterJson(msgspec.Struct):
    type: Literal["bool", "int", "float", "string"]
    unit: _Text = ""
    min: float | None = None
    max: float | None = None
    choices: Annotated[list[bool | int | float | str], Meta(max_length=MOST_CHOICES)] = []
    default: bool | int | float | str | None = None
    max_length: int | None = None
    description: _Text = ""


class _ActionJson(msgspec.Struct):
    name: Annotated[str, Meta(pattern=r"\A[A-Za-z0-9_.-]{1,64}\Z")]
    risk: Risk
    description: _Text = ""
    timeout_s: Annotated[float, Meta(ge=0, le=LONGEST_TIMEOUT_S)] = 30.0
    simulated: bool = False
    parameters: Annotated[dict[str, _ParameterJson], Meta(max_length=MOST_PARAMETERS)] = {}
    recovers: Annotated[list[_Text], Meta(max_length=MOST_ACTIONS)] = []


class _AnnouncementJson(msgspec.Struct):
    actions: list[msgspec.Raw] = []
    tests: list[msgspec.Raw] = []
    left_out: int = 0


def read_announcement(text: str | bytes) -> tuple[dict[str, AnnouncedAction], int]:
    """Return the actions by name that a robot has announced, and how many are left out.

    The robot wrote the text: what has not the form of an announced action is left out. Unit tests
    of the robot are actions with the prefix ``test.``.
    """
    try:
        said = msgspec.json.decode(text, type=_AnnouncementJson)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return {}, 0
    entries = [("", raw) for raw in said.actions] + [("test.", raw) for raw in said.tests]
    found: dict[str, AnnouncedAction] = {}
    for prefix, raw in entries[: 2 * MOST_ACTIONS]:
        with contextlib.suppress(msgspec.MsgspecError, ValueError, RecursionError):
            action = _announced(prefix, msgspec.json.decode(raw, type=_ActionJson))
            found.setdefault(action.name, action)
    return found, max(said.left_out, 0) + len(entries) - len(found)


def _announced(prefix: str, said: _ActionJson) -> AnnouncedAction:
    """Return an announced action; raises ValueError for one that no folder can declare."""
    parameters = {}
    for name, one in said.parameters.items():
        is_text = one.type == "string" and one.max_length is not None
        parameter = ParameterOptions(
            one.type, one.unit, one.min, one.max, tuple(one.choices), one.default,
            one.max_length or 0 if is_text else 100, one.description,
        )  # fmt: skip
        if not _PARAMETER_NAME.fullmatch(name) or any(parameter.check()):
            raise ValueError(f"the parameter {_shown(name)} is not one")
        parameters[name] = parameter
    for text in (said.description, *said.recovers):
        if any(_unfit("", text)):
            raise ValueError("a text is not one for people")
    return AnnouncedAction(
        prefix + said.name, said.risk, said.description, said.timeout_s, said.simulated,
        parameters, tuple(said.recovers),
    )  # fmt: skip


class HasParameters(Protocol):
    """What has parameters: an action, or an experiment."""

    @property
    def parameters(self) -> Mapping[str, ParameterOptions]:
        """Return its parameters by name."""


def parameters_of_words(declared: HasParameters, words: Sequence[str]) -> dict[str, Any]:
    """Return the values in words ``NAME=VALUE``; ``check_parameters`` judges them.

    Raises UsageError for other words, and for a name that is given twice.
    """
    return values_of_words({name: one.kind for name, one in declared.parameters.items()}, words)


def values_of_words(kinds: Mapping[str, str], words: Sequence[str]) -> dict[str, Any]:
    """Return the values in words ``NAME=VALUE``, by the kinds of parameters.

    ``accept_values`` judges them. Raises UsageError for other words, and for a name that is given
    twice.
    """
    found: dict[str, Any] = {}
    for word in words:
        name, is_given, value = word.partition("=")
        if not is_given:
            raise UsageError(f"'{word}' is no parameter", "write it as distance_m=0.5")
        if name in found:
            raise UsageError(f"'{name}' is given twice", "each parameter has one value")
        found[name] = _value_of_word(kinds[name], value) if name in kinds else value
    return found


def _value_of_word(kind: str, text: str) -> Any:
    if kind == "bool":
        return _YES_NO.get(text.lower(), text)
    if kind != "string":
        with contextlib.suppress(ValueError):
            return int(text)
        with contextlib.suppress(ValueError):
            return float(text)
    return text


def check_parameters(action: DeclaredAction | AnnouncedAction, text: str) -> dict[str, Value]:
    """Return the values of all parameters, from the JSON text of an object.

    Defaults are filled in. Raises UsageError that names everything that is wrong.
    """
    return accept_values(action.parameters, _object(text), action.name)


def accept_values(
    known: Mapping[str, ParameterOptions], given: Mapping[str, Any], whose: str
) -> dict[str, Value]:
    """Return the values of all parameters, from those given; defaults are filled in.

    Raises UsageError that names everything that is wrong.
    """
    values: dict[str, Value] = {}
    wrong = [
        f"there is no parameter {_shown(key)}{did_you_mean(key, known)}"
        for key in list(given)[:MOST_PARAMETERS]
        if key not in known
    ]
    for name, parameter in known.items():
        if name not in given and parameter.default is None:
            wrong.append(f"{name} is missing")
            continue
        try:
            values[name] = parameter.accept(given.get(name, parameter.default))
        except ValueError as error:
            wrong.append(f"{name}: {error}")
    if wrong:
        names = ", ".join(known) if known else "none"
        raise UsageError("; ".join(wrong), f"parameters of {whose}: {names}")
    return values


def _object(text: str) -> dict[str, Any]:
    """Decode a JSON object strictly: no key twice, no NaN, no endless numbers or depths."""
    if len(text) > PARAMETERS_BYTES:
        raise UsageError(f"the parameters have more than {PARAMETERS_BYTES} characters")
    try:
        found = json.loads(
            text, object_pairs_hook=_unique, parse_constant=_no_constant, parse_int=_whole
        )
    except (ValueError, RecursionError) as error:
        reason = str(error) if isinstance(error, ValueError) else "it is nested too deeply"
        raise UsageError(f"the parameters are no JSON: {reason}") from None
    if not isinstance(found, dict):
        raise UsageError("the parameters are no JSON object", 'such as {"distance_m": 0.5}')
    return found


def _unique(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a name is given twice")
    return found


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number")


def _whole(digits: str) -> int:
    if len(digits) > _LONGEST_NUMBER:
        raise ValueError(f"a number has {len(digits)} digits")
    return int(digits)
