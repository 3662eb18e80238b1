"""Questions about a file and their answers, as the command line and the server give them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from amberbox.core.contracts import Budget
from amberbox.core.errors import UsageError, did_you_mean
from amberbox.diagnosis.consistency.circuits import Circuit, read_circuit
from amberbox.diagnosis.consistency.components import Step, load_components, read_value, value_text
from amberbox.diagnosis.consistency.engines import SolverName
from amberbox.diagnosis.consistency.history import History
from amberbox.diagnosis.consistency.integers import Net
from amberbox.diagnosis.consistency.question import Answer, Question, of_circuit

T = TypeVar("T")


def question_about(
    path: Path, observe: Sequence[str], budget: Budget, solver: SolverName = ""
) -> Question:
    """Return the question about a model, or a circuit (``.bench``), with what was observed.

    ``observe`` are texts ``NAME=VALUE``, of each step; where modes change with time, of the last
    one. Raises UsageError, also for a model that is wrong.
    """
    if path.suffix == ".bench":
        circuit = read_circuit(path)
        levels = observed_values(observe, lambda name, text: _level(circuit, name, text))
        return of_circuit(circuit, [levels], budget, solver)
    model = load_components(path)
    seen = observed_values(observe, lambda name, text: read_value(text, name, model))
    steps = list(model.steps) or [Step()]
    first = len(steps) - 1 if model.is_timed else 0
    steps[first:] = [replace(one, observe={**one.observe, **seen}) for one in steps[first:]]
    return History.of(model, steps, budget).question(budget, solver)


def answer_json(answer: Answer) -> dict[str, Any]:
    """Return diagnoses as lists of ``component=mode`` with their ranks, and conflicts."""
    return {
        "conflicts": answer.conflicts,
        "diagnoses": [names for _, names in answer.diagnoses],
        "ranks": [rank for rank, _ in answer.diagnoses],
        "rank": answer.rank,
        "count": len(answer.diagnoses),
        "incomplete": answer.incomplete,
    }


def components_json(path: Path) -> dict[str, Any]:
    """Return the parts of a model: types and modes of components, ports that are joined, steps.

    Raises ConfigurationError with everything that is wrong in the file.
    """
    model = load_components(path)
    joined: dict[Net, list[str]] = {}
    for port, net in model.nets.items():
        joined.setdefault(net, []).append(port)
    return {
        "components": dict(model.components),
        "modes": {name: list(kind.modes) for name, kind in model.types.items()},
        "ports": list(model.nets),
        "connections": [ports for ports in joined.values() if len(ports) > 1],
        "steps": [
            [
                f"{port}={value_text(value)}"
                for port, value in (*step.commands.items(), *step.observe.items())
            ]
            for step in model.steps
        ],
    }


def observed_values(entries: Sequence[str], read: Callable[[str, str], T]) -> Mapping[str, T]:
    """Read texts ``NAME=VALUE``; raises UsageError for others."""
    found: dict[str, T] = {}
    for entry in entries:
        name, equals, text = entry.partition("=")
        if not equals:
            raise UsageError(f"--observe: '{entry}' is not NAME=VALUE")
        found[name] = read(name, text)
    return found


def _level(circuit: Circuit, name: str, text: str) -> bool:
    signals = [*circuit.inputs, *circuit.gates]
    if name not in signals:
        raise UsageError(f"--observe: there is no signal '{name}'{did_you_mean(name, signals)}")
    if text not in ("0", "1"):
        raise UsageError(f"--observe: {name} is 0 or 1, not '{text}'")
    return text == "1"
