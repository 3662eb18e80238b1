"""Print the tables of docs/start/simulator.md: topics, faults and kinds of disturbances."""

from __future__ import annotations

from collections.abc import Iterator

from amberbox.sim.disturbances import CONVERSIONS, kinds_as_rows
from amberbox.sim.faults import SimulatedFault, catalogue
from amberbox.sim.topics import NODES, TOPICS, WHEELS, TopicSpec, leaves

_REPEATED = {"wheels": ("<wheel>", WHEELS), "nodes": ("<node>", NODES)}


def topic_tables() -> str:
    """Return one Markdown section per topic with its columns."""
    return "\n".join(line for spec in TOPICS for line in _topic(spec))


def fault_table() -> str:
    """Return the fault catalogue as a Markdown table."""
    head = ["| fault | component | domain | magnitude | onset | what it is | shows in |"]
    return "\n".join([*head, "|" + "---|" * 7, *map(_fault_row, catalogue().values())])


def disturbance_table() -> str:
    """Return the kinds of disturbances as a Markdown table, and the conversions of units."""
    head = "| kind | disturbs | amount | what happens |\n|---|---|---|---|"
    disturbs = {"both": "messages, or a variable", "item": "messages", "variable": "a variable"}
    rows = [
        f"| `{kind}` | {disturbs[reach]} | {amount} | {description} |"
        for kind, reach, amount, description in kinds_as_rows()
    ]
    names = ", ".join(f"`{name}`" for name in CONVERSIONS)
    return "\n".join([head, *rows, "", f"Conversions of `unit`: {names}."])


def _topic(spec: TopicSpec) -> Iterator[str]:
    rate = f"{spec.rate_hz:g} Hz" if spec.rate_hz else "when something happens"
    yield f"### {spec.name}\n\n{spec.description} {rate.capitalize()}.\n"
    yield "| column | type | unit |\n|---|---|---|"
    for path, kind, unit in _without_repetition(spec):
        yield f"| `{path}` | {kind} | {unit} |"
    yield ""


def _without_repetition(spec: TopicSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the columns; those that repeat for each wheel or process only once."""
    word, names = _REPEATED.get(spec.name, ("", ()))
    for path, kind, unit in leaves(spec.body):
        parts = path.split(".")
        if not set(parts) & set(names[1:]):
            yield ".".join(word if part in names[:1] else part for part in parts), kind, unit


def _fault_row(fault: SimulatedFault) -> str:
    size = fault.magnitude
    amount = f"{size.default:g} ({size.low:g} to {size.high:g}) {size.unit}"
    shows = ", ".join(f"`{variable}`" for variable in fault.shows_in)
    cells = (f"`{fault.id}`", f"`{fault.component}`", fault.domain, amount, str(fault.onset))
    return f"| {' | '.join(cells)} | {fault.description} | {shows} |"


if __name__ == "__main__":
    print(topic_tables(), fault_table(), disturbance_table(), sep="\n")
