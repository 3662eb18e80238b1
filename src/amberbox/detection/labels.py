"""Labels: when faults of a record began and ended, from a YAML or a CSV file."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from amberbox.core.config import raise_errors
from amberbox.core.errors import Problem, UsageError, did_you_mean
from amberbox.core.files import read_at_most
from amberbox.core.yaml_nodes import Node, load_yaml

_KEYS = ("from", "to", "item", "source", "name")
_MOST_BYTES = 8 << 20
_MOST_LABELS = 10_000


@dataclass(frozen=True, slots=True)
class FaultLabel:
    """One fault: when it began and ended (ns), and what an alarm about it should name.

    ``item`` is a data item, or ``item.variable``; ``source`` is the source of the items.
    """

    from_ns: int
    to_ns: int
    item: str = ""
    source: str = ""
    name: str = ""


def read_labels(path: Path, time_ns: Callable[[str], int | None]) -> list[FaultLabel]:
    """Return the labels of a file in order of time; ``time_ns`` reads a time.

    Raises ConfigurationError with all that is wrong.
    """
    problems: list[Problem] = []
    entries = _csv(path, problems) if path.suffix.lower() == ".csv" else _yaml(path, problems)
    if not entries and not problems:
        hint = "one label is {from: TIME, to: TIME, item: NAME}"
        problems.append(Problem(str(path), 1, "labels", "there is no label", hint))
    labels = [_label(node, time_ns, problems) for node in entries[:_MOST_LABELS]]
    if len(entries) > _MOST_LABELS:
        problems.append(entries[_MOST_LABELS].problem("labels", f"more than {_MOST_LABELS:,}"))
    raise_errors(problems)
    found = [label for label in labels if label is not None]
    return sorted(found, key=lambda label: (label.from_ns, label.to_ns))


def _yaml(path: Path, problems: list[Problem]) -> tuple[Node, ...]:
    node = load_yaml(path, problems)
    if node is None:
        return ()
    if node.items is None:
        problems.append(node.problem("labels", f"expected a list, got {node.kind}"))
    return node.items or ()


def _csv(path: Path, problems: list[Problem]) -> tuple[Node, ...]:
    data = read_at_most(path, _MOST_BYTES, "this is no file of labels")
    lines = data.decode("utf-8-sig", errors="replace").splitlines()
    reader = csv.DictReader(lines, restkey="")
    try:
        return tuple(_csv_node(str(path), reader.line_num, row) for row in reader)
    except csv.Error as error:
        problems.append(Problem(str(path), reader.line_num, "labels", f"no CSV: {error}"))
        return ()


def _csv_node(file: str, line: int, row: Mapping[str, object]) -> Node:
    values = {str(key).strip(): value for key, value in row.items() if value not in (None, "")}
    return Node(file, line, {key: Node(file, line, str(v).strip()) for key, v in values.items()})


def _label(
    node: Node, time_ns: Callable[[str], int | None], problems: list[Problem]
) -> FaultLabel | None:
    before = len(problems)
    given = node.mapping
    if given is None:
        problems.append(node.problem("label", f"expected a mapping, got {node.kind}"))
        return None
    for key, entry in given.items():
        if key not in _KEYS:
            hint = f"there are {', '.join(_KEYS)}"
            problems.append(entry.problem(key, f"unknown key{did_you_mean(key, _KEYS)}", hint))
        elif entry.mapping is not None or entry.items is not None:
            problems.append(entry.problem(key, f"expected a word, got {entry.kind}"))
    times = {}
    for key in ("from", "to"):
        if key not in given:
            problems.append(node.problem(key, "is missing: when the fault began and ended"))
            continue
        try:
            times[key] = time_ns(str(given[key].value))
        except UsageError as error:
            problems.append(given[key].problem(key, error.what, error.hint))
    from_ns, to_ns = times.get("from"), times.get("to")
    if len(problems) > before or from_ns is None or to_ns is None:
        return None
    if to_ns < from_ns:
        problems.append(given["to"].problem("to", "the fault ends before it begins"))
        return None
    texts = {k: str(given[k].value) for k in ("item", "source", "name") if k in given}
    return FaultLabel(from_ns, to_ns, **texts)
