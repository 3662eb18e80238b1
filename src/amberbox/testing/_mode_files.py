"""The parts of a mode that are written down: what its module defines, and its sample file."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, get_args

from amberbox.core.config import build, parse_yaml
from amberbox.core.describe import describe
from amberbox.core.errors import Problem
from amberbox.core.mode import Kind, Result, ResultType

_FILE_KEYS = frozenset(
    {"name", "monitor", "description", "mappings", "arguments", "states", "stale_after"}
)
_OUTPUT_KEYS = frozenset(
    {"name", "type", "expected", "result", "severity", "for", "heal", "flapping"}
    | {"description", "hint"}
)
_FLAGS = ("COLUMNS", "PER_INPUT", "TIMED", "SEES_SILENCE", "PARTS")


@dataclass(frozen=True)
class ModeFile:
    """A mode file as the sample shows it; for each mapping its inputs, and the results it has."""

    config: Any
    inputs: Sequence[Sequence[str]]
    bools: Sequence[int]
    """How many bool outputs each mapping has."""

    def results(self, module: ModuleType) -> list[Result]:
        """Return all results that its mappings have with this configuration."""
        results_of = getattr(module, "results_of", None)
        if results_of is None:
            return list(module.RESULTS)
        mappings = zip(self.inputs, self.bools, strict=True)
        found = (results_of(self.config, len(texts), bools) for texts, bools in mappings)
        return [*module.RESULTS, *(result for results in found for result in results)]


def module_problems(module: ModuleType, name: str) -> list[str]:
    """Return what is wrong with the names a mode defines, their documentation and its sample."""
    wanted = ("Config", "ACCEPTS", "RESULTS", "SAMPLE", "evaluate")
    missing = [n for n in wanted if not hasattr(module, n)]
    if missing:
        return [f"{name}: the module does not define {n}" for n in missing]
    found = [*_declared_problems(module), *_result_problems(module.RESULTS)]
    found += _config_problems(module.Config)
    if found:
        return [f"{name}: {what}" for what in found]
    try:
        mode_file(module, name)
    except AssertionError as error:
        return [str(error)]
    return []


def _declared_problems(module: Any) -> Iterator[str]:
    if not (module.__doc__ or "").strip():
        yield "the module has no docstring; its first line is shown to users"
    if not callable(module.evaluate):
        yield "evaluate is no function"
    accepts, kinds = module.ACCEPTS, get_args(Kind)
    if not isinstance(accepts, tuple) or not accepts or set(accepts) - set(kinds):
        yield f"ACCEPTS must be a tuple of {', '.join(kinds)}"
    elif "probe" in accepts and not (hasattr(module, "PROBE") or hasattr(module, "probe_of")):
        yield "it accepts probes and says neither PROBE nor probe_of"
    for flag in _FLAGS:
        if not isinstance(getattr(module, flag, False), bool):
            yield f"{flag} must be True or False"


def _result_problems(results: Any) -> Iterator[str]:
    if not isinstance(results, tuple) or not all(isinstance(r, Result) for r in results):
        yield "RESULTS must be a tuple of Result"
        return
    names = [result.name for result in results]
    if len(set(names)) < len(names):
        yield "RESULTS has a name twice"
    for result in results:
        if result.type not in get_args(ResultType):
            yield f"the result '{result.name}' has the unknown type '{result.type}'"
        if not result.doc:
            yield f"the result '{result.name}' has no doc"


def _config_problems(config: Any) -> Iterator[str]:
    is_frozen = dataclasses.is_dataclass(config) and vars(config)["__dataclass_params__"].frozen
    if not is_frozen or not isinstance(config, type):
        yield "Config is not a frozen dataclass"
        return
    yield from (f"the argument '{row.key}' has no doc" for row in describe(config) if not row.doc)


def mode_file(module: ModuleType, name: str, text: str = "") -> ModeFile:
    """Read a mode file for a mode, by default its ``SAMPLE``; raise AssertionError."""
    problems: list[Problem] = []
    root = parse_yaml(text or module.SAMPLE, f"{name}.SAMPLE", problems)
    entries = (root.mapping if root is not None else None) or {}
    assert not problems, "\n".join(map(str, problems))
    _assert_keys(entries, _FILE_KEYS, f"{name}.SAMPLE")
    monitor = entries["monitor"].text if "monitor" in entries else ""
    assert monitor == name, f"{name}.SAMPLE: must have the line 'monitor: {name}'"
    assert "name" in entries, f"{name}.SAMPLE: the key 'name' is missing"
    arguments = entries.get("arguments") or parse_yaml("{}", name, problems)
    assert arguments is not None
    config = build(module.Config, arguments, problems, "arguments")
    assert config is not None, "\n".join(map(str, problems))
    mappings = [_plain_mapping(node.plain()) for node in entries["mappings"].items or ()]
    assert mappings, f"{name}.SAMPLE: there are no mappings"
    inputs = [mapping["inputs"] for mapping in mappings]
    file = ModeFile(config, inputs, [_bools(mapping["outputs"]) for mapping in mappings])
    results = file.results(module)
    for output in (output for mapping in mappings for output in mapping["outputs"]):
        _assert_bound(output, results, f"{name}.SAMPLE: output '{output.get('name')}'")
    return file


def _bools(outputs: Sequence[Mapping[str, Any]]) -> int:
    return sum(output.get("type") == "bool" for output in outputs)


def _assert_keys(found: Mapping[str, Any], known: frozenset[str], where: str) -> None:
    assert set(found) <= known, f"{where}: unknown keys {sorted(set(found) - known)}"


def _plain_mapping(entry: Any) -> dict[str, Any]:
    inner = entry.get("mapping", entry)
    _assert_keys(inner, frozenset({"inputs", "outputs"}), "mapping")
    outputs = [output.get("output", output) for output in inner["outputs"]]
    for output in outputs:
        _assert_keys(output, _OUTPUT_KEYS, "output")
    return {"inputs": inner["inputs"], "outputs": outputs}


def _assert_bound(output: Mapping[str, Any], declared: Sequence[Result], where: str) -> None:
    assert output.get("name"), f"{where} has no name"
    kind = {"double": "float"}.get(output["type"], output["type"])
    wanted = output.get("result", output["name"])
    named = [result for result in declared if result.name == wanted]
    assert named or "result" not in output, f"{where}: there is no result '{wanted}'"
    fitting = {"int": ("int", "float")}.get(kind, (kind,))
    found = [result for result in named or declared if result.type in fitting]
    assert found, f"{where}: no result of the type {kind}"
