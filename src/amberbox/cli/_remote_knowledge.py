"""``amberbox fmea``, ``faulttree`` and ``rules`` about a robot on a server."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from amberbox.cli._output import check_time, print_grid, print_json, tell
from amberbox.cli._server import refuse_options, robot_at
from amberbox.core.errors import UsageError

_SHEET = ("Item", "Failure mode", "Severity", "S", "O", "D", "RPN", "Detection", "Action")
_LOCAL = "they are for a robot folder on this computer"
_LISTED = 3

Said = Mapping[str, Any]


def fmea_remote(args: argparse.Namespace) -> None:
    """Show the sheet, what matters most, or what nobody sees."""
    given = {"csv": args.csv, "import": args.import_, "priorities": args.priorities}
    refuse_options(args.where, given, _LOCAL)
    if args.action not in _FMEA:
        raise UsageError(f"fmea {args.action} is about files on this computer",
                         f"of a server: {', '.join(_FMEA)}")  # fmt: skip
    fleet, robot = robot_at(args.where)
    with fleet:
        found = fleet.fmea(robot, exposure_h=args.exposure)
    tell(found["notes"])
    if args.json:
        print_json(found[args.action])
    else:
        _FMEA[args.action](found[args.action])


def _table(rows: list[dict[str, str]]) -> None:
    header = [name.lower() if len(name) > 3 else name for name in _SHEET]
    print_grid(header, [[row[column] for column in _SHEET] for row in rows])


def _criticality(found: Said) -> None:
    rows = [(one["component"], f"{one['C_r']:.3g}") for one in found["components"]]
    print_grid(("component", "C_r"), rows)
    print()
    modes = [
        (one["mode"], one["severity"], "-" if one["RPN"] is None else one["RPN"],
         f"{one['C_m']:.3g}")
        for one in found["modes"]
    ]  # fmt: skip
    print_grid(("failure mode", "severity", "S x O x D", "C_m"), modes)


def _coverage(found: Said) -> None:
    seen = found["modes"] - len(found["unseen"])
    print(f"{seen} of {found['modes']} failure modes show; {found['distinct']} can be told apart "
          "by that")  # fmt: skip
    _section("nothing shows", [f"{m}: {why}" for m, why in found["unseen"].items()])
    _section("show weakly", [f"{m}: seen in {s:.0%} of cases" for m, s in found["weak"].items()])
    _section("no failure mode explains", found["unexplained"])
    _section("look the same", [", ".join(group["modes"]) for group in found["alike"]])


def _section(title: str, lines: list[str]) -> None:
    if lines:
        print("\n".join([f"{title} ({len(lines)}):", *(f"  {line}" for line in lines)]))


_FMEA: dict[str, Callable[[Any], None]] = {
    "table": _table,
    "criticality": _criticality,
    "coverage": _coverage,
}


def faulttree_remote(args: argparse.Namespace) -> int:
    """Show the trees of all functions, of one, or which cut sets are closest to complete."""
    refuse_options(args.where, {"export": args.export}, _LOCAL)
    if args.at and not args.closest:
        raise UsageError("--at is for --closest", "amberbox faulttree URL --closest --at T")
    if args.importance and not args.effect:
        raise UsageError("a server tells of one function what matters", "--effect NAME")
    check_time("--at", args.at)
    fleet, robot = robot_at(args.where)
    with fleet:
        found = fleet.faulttrees(
            robot, args.effect, cut_sets=args.cut_sets or 0, order=args.order, at=args.at,
            exposure_h=args.exposure,
        )  # fmt: skip
    tell(found["notes"])
    if args.json:
        print_json(found)
    elif args.closest:
        print("\n".join(_closest(found, args.cut_sets or _LISTED)))
    elif args.effect:
        print("\n".join(_one(found, importance=args.importance)))
    else:
        header = ("effect", "probability", "cut sets", "of order", "smallest", "what is lost")
        print_grid(header, map(_effect, found["effects"]))
    if found.get("incomplete"):
        tell(["incomplete: the server gave up after its time"])
        return 1
    return 0


def _effect(one: Said) -> list[str]:
    chance = one["top_probability"]
    first = [one["effect"], "-" if chance is None else f"{chance:.3g}"]
    if one["by_order"] is None:
        return [*first, "-", "-", "-", one["description"]]
    counts = {order: count for order, count in enumerate(one["by_order"]) if count}
    by_order = ", ".join(f"{order}: {count:,}" for order, count in counts.items())
    smallest = str(min(counts)) if counts else "-"
    number = f"{one['minimal_cut_sets']:,}"
    return [*first, number, by_order or "-", smallest, one["description"]]


def _one(found: Said, *, importance: bool) -> Iterator[str]:
    size = f"{found['gates']} gates, {found['basic_events']} basic events"
    yield f"{found['effect']} ({found['description']}): {size}"
    if found["top_probability"] is not None:
        yield f"probability: {found['top_probability']:.10g} (exact)"
    if found["by_order"] is not None:
        yield f"minimal cut sets: {found['minimal_cut_sets']:,}"
        counts = enumerate(found["by_order"])
        yield from (f"  order {order}: {count:,}" for order, count in counts if count)
    yield from ("  {" + ", ".join(entry) + "}" for entry in found.get("cut_sets", ()))
    if importance and found["importance"]:
        yield ""
        for event, factors in found["importance"].items():
            told = (f"{k.upper()} {'-' if v is None else f'{v:.6g}'}" for k, v in factors.items())
            yield f"{event}: {', '.join(told)}"


def _closest(found: Said, count: int) -> Iterator[str]:
    standing = found["diagnosis"]
    yield f"{found['at']}, {standing or 'no diagnosis: only what is known beforehand counts'}"
    for effect in found["closest"]:
        yield f"\n{effect['effect']}"
        for near in effect["closest"][:count]:
            parts = (("happened", near["happened"]), ("missing", near["missing"]))
            told = (f"{what}: {', '.join(events)}" for what, events in parts if events)
            yield f"  {near['probability']:.3g}  {'; '.join(told)}"


def rules_remote(args: argparse.Namespace) -> int:
    """Ask the robot's rules."""
    if args.files or args.export:
        raise UsageError("a server asks the rules that the robot has", "leave out files, --export")
    if args.ask is None:
        raise UsageError("a server is asked a goal", "--ask 'broken(X)'")
    want = "why_not" if args.why_not else "why" if args.why else ""
    check_time("--from", args.from_)
    check_time("--to", args.to)
    fleet, robot = robot_at(args.where)
    with fleet:
        found = fleet.rules(robot, args.ask, want, args.from_, args.to)
    tell(found["notes"])
    if args.json:
        print_json({name: found[name] for name in ("answers", "proof", "failed")})
    else:
        print("\n".join(_answers(found)))
    return 0


def _answers(found: Said) -> Iterator[str]:
    for number, answer in enumerate(found["answers"]):
        yield ", ".join(f"{name} = {value}" for name, value in answer.items()) or "yes"
        for node in found["proof"][number] if found["proof"] else ():
            yield from _proof(node, "  ")
    for failure in found["failed"]:
        yield from _failure(failure, "")
    if not found["answers"] and not found["failed"]:
        yield "no"


def _proof(node: Said, indent: str) -> Iterator[str]:
    kind = "" if node["by"] in ("builtin", "lookup") else node["by"]
    source = ", ".join(filter(None, (kind, node.get("at", ""))))
    again = "   (shown above)" if node.get("shown_above") else f"   {source}" if source else ""
    yield f"{indent}{node['goal']}{again}"
    for below in node.get("because", ()):
        yield from _proof(below, f"{indent}  ")


def _failure(failure: Said, indent: str) -> Iterator[str]:
    yield f"{indent}fails: {failure['goal']}   {failure['what']}".rstrip()
    for tried in failure["tried"]:
        yield f"{indent}  {tried['head']}   {tried['at']}"
        yield from (f"{indent}    holds: {goal}" for goal in tried["held"])
        yield from _failure(tried["failed"], f"{indent}    ")
