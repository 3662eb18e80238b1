"""``amberbox diagnose`` of a robot on a server: what the server answers, told as on the robot."""

from __future__ import annotations

import argparse
from typing import Any

import msgspec

from amberbox.cli._output import check_time, print_json, tell, text_output
from amberbox.cli._server import refuse_options, robot_at
from amberbox.cli._text import print_lines
from amberbox.client.times import time_ns
from amberbox.core.errors import UsageError
from amberbox.core.timetext import format_time
from amberbox.diagnosis.explanation import Explanation, as_svg, as_text
from amberbox.monitoring.messages.board import duration

_STATES = ("present", "absent", "unknown")


def run_remote(args: argparse.Namespace, lookback: str) -> int:
    """Ask, and show the answer; 0 if nothing is wrong, 1 if something is."""
    given = {"follow": args.follow, "folder": args.folder, "lookback": args.lookback != lookback}
    refuse_options(args.where, given, "the server has the robot's folder, and looks itself; "
                   "amberbox status URL --watch shows what changes")  # fmt: skip
    check_time("--at", args.at)
    fleet, robot = robot_at(args.where)
    with fleet:
        found = fleet.diagnose(
            robot, args.at, dict(map(_symptom, args.symptom)), dict(map(_answer, args.answer)),
            engine=args.engine, exposure_h=args.exposure,
        )  # fmt: skip
    explanation = _explanation(found)
    tell(str(note) for note in found.get("notes", ()))
    if args.svg:
        _draw(args.svg, explanation)
    if args.json:
        print_json(found)
    elif args.svg != "-":
        print_lines([_text(args.engine, found, explanation)])
    return int(found["state"] == "open")


def _symptom(text: str) -> tuple[str, str]:
    name, _, state = text.partition("=")
    if state and state not in _STATES:
        raise UsageError(f"'{state}' is no state of a symptom", f"one of {', '.join(_STATES)}")
    return name, state or "present"


def _answer(text: str) -> tuple[str, str]:
    test, equals, value = text.partition("=")
    if not (test and equals and value):
        raise UsageError(f"'{text}' is no answer", "write --answer TEST=VALUE")
    return test, value


def _explanation(found: dict[str, Any]) -> Explanation | None:
    said = found.get("explanation")
    return None if said is None else msgspec.convert(said, Explanation)


def _text(engine: str, found: dict[str, Any], explanation: Explanation | None) -> str:
    from amberbox.cli._diagnosis_show import alone_text

    if explanation is None:
        text = "nothing follows from them" if engine == "rules" else _nothing(found)
        return alone_text(engine, text)
    text = as_text(explanation).rstrip("\n")
    if found["state"] == "healed":
        ago = duration(max(0, time_ns(found["at"]) - explanation.at_ns))
        text = f"nothing is wrong now; the last diagnosis ended {ago} ago:\n\n{text}"
    return alone_text(engine, text)


def _nothing(found: dict[str, Any]) -> str:
    symptoms = found.get("symptoms", [])
    unknown = sum(symptom["state"] == "unknown" for symptom in symptoms)
    rest = f"; {unknown} are not known" if unknown else ""
    count = f"{len(symptoms)} symptom{'' if len(symptoms) == 1 else 's'}"
    at = format_time(time_ns(found["at"]))[:19]
    lines = [f"  found, and no failure mode explains it: {f}" for f in found.get("findings", ())]
    return "\n".join([f"nothing is wrong at {at}: of {count} none is there{rest}", *lines])


def _draw(path: str, explanation: Explanation | None) -> None:
    if explanation is None:
        tell(["there is no diagnosis, so nothing is drawn"])
        return
    with text_output(None if path == "-" else path) as file:
        file.write(as_svg(explanation))
