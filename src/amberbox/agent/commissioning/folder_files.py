"""The files of a new robot folder, written for people to read and to edit."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from amberbox.agent.commissioning.draft import DiagnosticSign, DraftedComponent, RobotDraft
from amberbox.agent.commissioning.rate import WINDOW_S, LearnedRate
from amberbox.core.names import child_name, item_name
from amberbox.core.safe_text import one_line

ROBOT = """\
# Who this robot is, and where its record goes. All keys: docs/robot/configuration.md

id: "{id}"                 # name in addresses and on the server: a-z 0-9 _ . -
model: ""                  # make and model
software_version: ""       # version of the robot's own software

store:
  path: store              # folder of the record, relative to this one
  # quota: 50 GB           # most that the record may take; the oldest data go first
  # min_free: 1 GB         # room that stays free on the partition
  # keep_min: 24 h         # the newest data are not deleted for room
  # ring_s: 5 min          # how long topics with 'keep: ring' are kept

# 'amberbox join' with the line that a fleet server printed writes the server here:
# server:
#   url: https://fleet.example.org:8443
#   copy: always           # when journals are copied: docked, on_request, network NAME
#   rate: 0                # most bytes in a second; 0 for as fast as it goes
"""

TRIGGERS = """
triggers:                  # the record around each alarm is kept: docs/robot/incidents.md
  - name: alarm
    when: >-
      amberbox_alarm.state == 'open' and not amberbox_alarm.live_only
      and amberbox_alarm.changed_ns == amberbox_alarm.opened_ns
    before: 60 s
    after: 20 s
    hold_off: 20 s
    reason: an alarm opened
"""

_PLAIN = re.compile(r"[A-Za-z_/][A-Za-z0-9_/.-]*")
_WORDS = frozenset(["true", "false", "yes", "no", "on", "off", "null", "y", "n", "none"])

_TOLERANCE = 30  # percent below the slowest window that was measured
_LEAST_AGE_S = 2.0  # from which silence is a fault
_MOST_RATE_OUTPUTS = 12


def yaml_text(text: str) -> str:
    """Write a text as YAML: plain where that is safe, else in quotes."""
    if _PLAIN.fullmatch(text) and text.lower() not in _WORDS:
        return text
    return json.dumps(text)


def drafted_files(
    draft: RobotDraft, block: str, probes: Mapping[str, tuple[str, str]], how: str
) -> dict[str, str]:
    """Return the files of components and failure modes by name.

    ``block`` is the name of the source's block, ``probes`` the kind and the subject of the probe
    of each node, and of the master under the empty name; ``how`` says when and how it was seen.
    """
    files: dict[str, str] = {}
    modes_of = {one.id: dict(_modes(one, draft, block, probes)) for one in draft.components}
    watched = [one for one in draft.components if modes_of[one.id]]
    for component in [*watched, *(one for one in draft.components if one.parts)]:
        modes = modes_of[component.id]
        needs = tuple(need for need in component.needs if modes_of[need.component])
        files |= {f"components/{component.id}/{name}.yaml": m for name, m in modes.items()}
        files[f"components/{component.id}.yaml"] = component_file(
            replace(component, needs=needs), modes
        )
    if "" in probes:
        kind, subject = probes[""]
        master = DraftedComponent(_master_id(draft), "the ROS master")
        mode = _process(kind, subject, "the ROS master answers", ("running",))
        files[f"components/{master.id}/process.yaml"] = mode
        files[f"components/{master.id}.yaml"] = component_file(master, ["process"])
    files["fmea.yaml"] = "".join(_fmea(watched, probes, draft, how))
    return files


def _master_id(draft: RobotDraft) -> str:
    taken = {component.id for component in draft.components}
    return "ros_master" if "ros_master" not in taken else "the_ros_master"


def component_file(component: DraftedComponent, modes: Collection[str]) -> str:
    """Return the file of a component with its modes."""
    lines = [f"# {one_line(remark)}." for remark in component.remarks]
    lines += [
        f"component_name: {yaml_text(component.id)}",
        f"description: {yaml_text(one_line(component.what))}",
        "modes:" if modes else "modes: []",
        *(f"  - {component.id}/{mode}.yaml" for mode in modes),
    ]
    if component.parts:
        parts = (f"  - {part}" for part in component.parts)
        return "\n".join([*lines, "dependencies:             # its parts", *parts]) + "\n"
    if not component.needs:
        lines.append("dependencies: []")
        return "\n".join(lines) + "\n"
    lines.append("dependencies:             # guesses: strike out what it can do without")
    width = max(len(need.component) for need in component.needs)
    lines += [
        f"  - {need.component:<{width}}   # guess: it listens to {one_line(need.topic)}"
        for need in component.needs
    ]
    return "\n".join(lines) + "\n"


def _modes(
    component: DraftedComponent,
    draft: RobotDraft,
    block: str,
    probes: Mapping[str, tuple[str, str]],
) -> Iterator[tuple[str, str]]:
    """Yield the mode files of a component, by the names of the modes."""
    if component.node in probes and component.node:
        kind, subject = probes[component.node]
        if _asks_node(component, probes):
            yield "process", _process(kind, subject, f"{component.what} runs and answers")
        else:
            yield "process", _process(kind, subject, f"{component.what} runs", ("running",))
    if component.rates:
        yield "topics", topics_mode(component.rates, component.what)
    if component.log_name and draft.log_topic:
        yield "log", _log(component, draft)
    if component.diagnostics is not None and draft.diagnostics_topic:
        yield "diagnostics", _diagnostics(component.what, component.diagnostics, draft, block)
    if component.goals:
        yield "goals", _goals(component.goals, block)
    if component.calls:
        yield "calls", _calls(component.calls, block)


def _asks_node(component: DraftedComponent, probes: Mapping[str, tuple[str, str]]) -> bool:
    """Return whether the probe of a node also tells that it does not answer."""
    return probes.get(component.node, ("", ""))[0] != "ros2_node"


_HINTS = {
    "running": "look into its log why it ended, and start it again",
    "responds": "it is there and hangs: restart it",
}

_DELAYS = {"responds": "            for: 3 s             # it is asked every 2 s\n"}


def _process(
    kind: str, subject: str, description: str, outputs: Sequence[str] = ("running", "responds")
) -> str:
    found = [f"""\
        - output:
            name: {name}
            type: bool
            severity: critical
            heal: 2 s
{_DELAYS.get(name, "")}            hint: {yaml_text(_HINTS[name])}
""" for name in outputs]  # fmt: skip
    return f"""\
name: process
monitor: service
description: {yaml_text(one_line(description))}
mappings:
  - mapping:
      inputs: [{yaml_text(subject)}]
      outputs:
{"".join(found)}arguments: {{kind: {kind}}}
"""


def topics_mode(rates: Mapping[str, LearnedRate], what: str) -> str:
    """Return the mode file that watches the rates of topics or items."""
    names = [yaml_text(name) for name in rates]
    heard = "".join(
        f"    {yaml_text(name)}: {rate.low_hz:.3g}    # {rate.mean_hz:.3g} Hz on average, "
        f"no longer than {rate.longest_gap_s:.2g} s between two messages\n"
        for name, rate in rates.items()
    )
    measured = ""
    if len(rates) <= _MOST_RATE_OUTPUTS:
        measured = "".join(
            f"        - output: {{name: {name}, result: rate_hz, type: float}}\n"
            for name in _output_names(rates)
        )
    age_s = max(_LEAST_AGE_S, *(2 * rate.longest_gap_s for rate in rates.values()))
    return f"""\
name: topics
monitor: heartbeat
description: {yaml_text(f"{one_line(what)} sends its topics as often as it did")}
mappings:
  - mapping:
      inputs: [{", ".join(names)}]
      outputs:
        - output:
            name: heard
            type: bool
            severity: urgent
            heal: 2 s
            hint: does it run, and has it what it needs?
        - output:
            name: often_enough
            type: bool
            severity: warning
            for: 1 s
            heal: 3 s
            hint: look at the load of its computer, and at what it listens to
        - output:
            name: connected
            type: bool
            severity: urgent
            heal: 2 s
            hint: it ended, or the network to its computer is cut
{measured}arguments:
  tolerance: {_TOLERANCE} %
  window: {WINDOW_S:g} s
  max_age: {age_s:.2g} s
  rates:                  # Hz, of the slowest {WINDOW_S:g} s while it was learned
{heard}"""


def _output_names(names: Iterable[str]) -> list[str]:
    """Return a name of an output for each topic: its last word where that is unique."""
    found: list[str] = []
    for name in names:
        free = item_name("", name.rpartition("/")[2]).lower() + "_hz"
        found.append(free if free not in found else item_name("", name).lower() + "_hz")
    return [name if found.count(name) == 1 else f"{name}_{place}"
            for place, name in enumerate(found)]  # fmt: skip


def _log(component: DraftedComponent, draft: RobotDraft) -> str:
    topic = draft.log_topic
    inputs = ", ".join(yaml_text(f"{topic}/{name}") for name in ("msg", "level", "name"))
    return f"""\
name: log
monitor: log_pattern
description: {yaml_text(f"{one_line(component.what)} logs no errors")}
stale_after: never
mappings:
  - mapping:
      inputs: [{inputs}]
      outputs:
        - output:
            name: no_errors
            type: bool
            result: ok
            severity: warning
            hint: read the line
        - output: {{name: last_error, result: last_line, type: string}}
arguments:
  pattern: ""             # any line; narrow it down where it logs errors that do not matter
  level: {draft.log_level}
  of: {yaml_text(component.log_name)}
  silence_ok: true
  window: 30 s
"""


def _diagnostics(what: str, sign: DiagnosticSign, draft: RobotDraft, block: str) -> str:
    patterns = "".join(f"    - {json.dumps(pattern)}\n" for pattern in sign.patterns)
    table = child_name(item_name(block, draft.diagnostics_topic), "status")
    return f"""\
name: diagnostics
monitor: diagnostics
description: {yaml_text(f"what {one_line(what)} reports of itself")}
mappings:
  - mapping:
      inputs: [{table}]
      outputs:
        - output: {{name: no_error, result: ok, type: bool, severity: urgent}}
        - output: {{name: level, type: int, expected: 0, severity: warning}}
        - output: {{name: message, type: string}}
arguments:
  worst: warn             # as an error; a warning shows in the level
  max_age: {sign.max_age_s:g} s
{"" if sign.count is None else f"  count: {sign.count}{chr(10)}"}\
{"  absent_ok: true" + chr(10) if sign.absent_ok else ""}\
  names:
{patterns}"""


def _goals(goals: Mapping[str, tuple[int, ...]], block: str) -> str:
    failed = sorted({status for statuses in goals.values() for status in statuses})
    tables = [child_name(item_name(block, topic), "status_list") for topic in goals]
    return _outcomes("goals", f"goals do not fail: {_listed(goals)}", tables, f"failed: {failed}")


def _calls(calls: Sequence[str], block: str) -> str:
    tables = [child_name(item_name(block, topic), "response") for topic in calls]
    says = f"calls of its services do not fail: {_listed(calls)}"
    return _outcomes("calls", says, tables, "of: calls")


def _listed(topics: Iterable[str]) -> str:
    return ", ".join(map(one_line, topics))


def _outcomes(name: str, says: str, tables: Sequence[str], argument: str) -> str:
    return f"""\
name: {name}
monitor: goals
description: {yaml_text(says)}
mappings:
  - mapping:
      inputs: [{", ".join(tables)}]
      outputs:
        - output: {{name: none_failed, type: bool, severity: warning}}
arguments:
  {argument}
"""


_FMEA_HEAD = """\
# What can fail, how it shows, and what to do about it: a start, {how}.
# All keys: docs/robot/fmea.md. 'amberbox fmea coverage' lists what is not told apart.
#
# The rates are failures per hour, as far as nobody knows better: dying is more frequent than
# hanging. Correct them, add causes that you know (a fuse, a driver, a cable), and give them a test.
# What a part needs is in 'dependencies' of its component file.

exposure_h: 24             # since everything was last known to be well

defaults:
  detects: 0.97
  within_s: 20
  hold_s: 30
  exclusive: true          # a part fails in one way at a time; name others under 'with'

# functions:               # what the robot is for, and what has to work for that
#   drive:
#     needs: [move_base, base]
#     system: true
#     severity: critical

"""


def _fmea(
    components: Sequence[DraftedComponent],
    probes: Mapping[str, tuple[str, str]],
    draft: RobotDraft,
    how: str,
) -> Iterator[str]:
    yield _FMEA_HEAD.format(how=how)
    kinds: dict[tuple[str, ...], list[DraftedComponent]] = {}
    for component in components:
        kinds.setdefault(_signs(component, probes, draft), []).append(component)
    taken = {component.id for component in components}
    names = {signs: _kind_name(signs, taken) for signs in kinds}
    if kinds:
        yield "instances:\n"
    for signs, members in kinds.items():
        yield f"  {names[signs]}:\n"
        for one in members:
            shown = one_line(one.node or one.what).replace("<", "(").replace(">", ")")
            yield f"    {one.id}: {{node: {yaml_text(shown)}}}\n"
    yield "\ntypes:\n" if kinds or "" in probes else ""
    for signs in kinds:
        yield from _kind(names[signs], signs)
    if "" in probes:
        yield _MASTER.format(id=_master_id(draft))


def _signs(
    component: DraftedComponent, probes: Mapping[str, tuple[str, str]], draft: RobotDraft
) -> tuple[str, ...]:
    """Return the modes that a component has."""
    has_process = bool(component.node) and component.node in probes
    has = {
        "process": has_process,
        "answers": has_process and _asks_node(component, probes),
        "found": has_process and not _asks_node(component, probes),
        "topics": bool(component.rates),
        "log": bool(component.log_name and draft.log_topic),
        "diagnostics": bool(component.diagnostics and draft.diagnostics_topic),
        "goals": bool(component.goals),
        "calls": bool(component.calls),
    }
    return tuple(name for name, is_there in has.items() if is_there)


def _kind_name(signs: Sequence[str], taken: set[str]) -> str:
    shown = [sign for sign in signs if sign not in ("process", "answers", "found", "log")]
    name = "_and_".join(["node_with_" + shown[0], *shown[1:]]) if shown else "node"
    while name in taken:
        name += "_kind"
    taken.add(name)
    return name


@dataclass(frozen=True, slots=True)
class _FailureMode:
    """A failure mode of a node: the signs of which one is needed, and its lines in the file."""

    name: str
    of: tuple[str, ...]
    text: str
    symptoms: tuple[tuple[str, str], ...]
    tests: tuple[tuple[str, str], ...] = ()


_PROCESS, _TOPICS = "process", "topics"
# the process answers a call; it is only found in the graph; what has none of both or is only found
_ANSWERS, _FOUND, _LISTED = "answers", "found", "listed"

_FAILURE_MODES = (
    _FailureMode(
        "died",
        (_PROCESS, _TOPICS),
        """\
        description: <node> has ended
        cause: it crashed, somebody stopped it, or its computer is off
        rate: 2.0e-4
        severity: critical
        remedy: look into its log why it ended, and start it again
""",
        (
            (_PROCESS, "{symptom: <component>/process/running, detects: 0.98}"),
            (_TOPICS, "{symptom: <component>/topics/connected, detects: 0.95}"),
            (_TOPICS, "{symptom: <component>/topics/heard, detects: 0.98}"),
        ),
        ((_ANSWERS, "ping: refused"), (_LISTED, 'listed: "no"')),
    ),
    _FailureMode(
        "hangs",
        (_ANSWERS, _TOPICS),
        """\
        description: <node> is there and does nothing any more
        cause: it waits for something for ever, was stopped, or its computer swaps
        rate: 5.0e-5
        severity: critical
        remedy: restart it; 'py-spy dump' or 'gdb -p' before that shows where it hangs
""",
        (
            (_ANSWERS, "{symptom: <component>/process/responds, detects: 0.6}"),
            (_TOPICS, "{symptom: <component>/topics/heard, detects: 0.98}"),
        ),
        ((_ANSWERS, "ping: {outcome: nothing, detects: 0.6}"), (_TOPICS, 'works: "no"')),
    ),
    _FailureMode(
        "silent",
        (_TOPICS,),
        """\
        description: <node> runs, and a topic of it does not come
        cause: its device or its input is gone
        rate: 1.0e-4
        severity: urgent
        remedy: look at its device, and at the topics it listens to
""",
        ((_TOPICS, "{symptom: <component>/topics/heard, detects: 0.98}"),),
        ((_TOPICS, 'input: {outcome: "no", detects: 0.8}'),),
    ),
    _FailureMode(
        "slow",
        (_TOPICS,),
        """\
        description: <node> sends too slowly
        cause: its computer is overloaded, or its input is slow
        rate: 2.0e-4
        severity: warning
        remedy: look what takes the processor ('top')
""",
        ((_TOPICS, "{symptom: <component>/topics/often_enough, detects: 0.97}"),),
        ((_TOPICS, 'busy: {outcome: "yes", detects: 0.7}'),),
    ),
    _FailureMode(
        "logs_errors",
        ("log",),
        """\
        description: <node> logs errors
        rate: 1.0e-3
        severity: warning
        takes_down: false
        remedy: read the line; amberbox status shows it
""",
        (("log", "{symptom: <component>/log/no_errors, detects: 0.99}"),),
    ),
    _FailureMode(
        "reports_error",
        ("diagnostics",),
        """\
        description: <node> reports an error of itself
        rate: 2.0e-4
        severity: urgent
        remedy: do what its message says
""",
        (
            ("diagnostics", "{symptom: <component>/diagnostics/no_error, detects: 0.97}"),
            ("diagnostics", "{symptom: <component>/diagnostics/level, detects: 0.97}"),
        ),
    ),
    _FailureMode(
        "reports_warning",
        ("diagnostics",),
        """\
        description: <node> warns of itself
        rate: 5.0e-4
        severity: warning
        takes_down: false
        remedy: do what its message says
""",
        (("diagnostics", "{symptom: <component>/diagnostics/level, detects: 0.99}"),),
    ),
    _FailureMode(
        "goal_fails",
        ("goals",),
        """\
        description: <node> does not reach a goal
        rate: 1.0e-2
        severity: warning
        takes_down: false
        remedy: look what it was asked for, and at what it needs
""",
        (("goals", "{symptom: <component>/goals/none_failed, detects: 0.95}"),),
    ),
    _FailureMode(
        "call_fails",
        ("calls",),
        """\
        description: a service of <node> answers that a call failed
        rate: 1.0e-2
        severity: warning
        takes_down: false
        remedy: read the message of the answer, and look at what it was asked for
""",
        (("calls", "{symptom: <component>/calls/none_failed, detects: 0.95}"),),
    ),
)

# how soon a symptom shows; those of the process do not depend on what a node needs
_SYMPTOMS = (
    (_ANSWERS, "<component>/process/running: {within_s: 8, by_itself: true}"),
    (_ANSWERS, "<component>/process/responds: {within_s: 15, by_itself: true}"),
    (_FOUND, "<component>/process/running: {within_s: 25, by_itself: true}"),  # a lease
    (_TOPICS, "<component>/topics/connected: {within_s: 5, by_itself: true}"),
)
_TESTS = (
    (
        _ANSWERS,
        """\
      ping:
        question: "What does 'rosnode ping <node>' say?"
        outcomes: [answers, refused, nothing]
        minutes: 0.5
""",
    ),
    (
        _LISTED,
        """\
      listed:
        question: Is <node> in the list of nodes?
        outcomes: ["yes", "no"]
        minutes: 0.5
""",
    ),
    (
        _TOPICS,
        """\
      works:
        question: "Does 'top' show that <node> uses the processor?"
        outcomes: ["yes", "no"]
      input:
        question: Does what <node> reads come (its device, the topics it listens to)?
        outcomes: ["yes", "no"]
        minutes: 2
      busy:
        question: "Does 'top' show a processor that is fully used?"
        outcomes: ["no", "yes"]
""",
    ),
)
_MASTER = """\
  {id}:
    description: the ROS master
    failure_modes:
      gone:
        description: "the ROS master is gone: nodes that run go on, nothing new can connect"
        rate: 2.0e-5
        severity: urgent
        symptoms: [{id}/process/running]
        remedy: start roscore again, and then all nodes
"""


def _kind(name: str, signs: Sequence[str]) -> Iterator[str]:
    """Yield the type of the components that have the same signs."""
    if _ANSWERS not in signs and {_TOPICS, _FOUND} & set(signs):
        signs = (*signs, _LISTED)
    yield f"  {name}:\n    description: <node>\n"
    found = _of_signs(_SYMPTOMS, signs)
    yield "".join(["    symptoms:\n", *(f"      {line}\n" for line in found)]) if found else ""
    yield "    failure_modes:\n"
    for mode in _FAILURE_MODES:
        if not set(mode.of) & set(signs):
            continue
        yield f"      {mode.name}:\n{mode.text}        symptoms:\n"
        yield from (f"          - {line}\n" for line in _of_signs(mode.symptoms, signs))
        tests = _of_signs(mode.tests, signs)
        yield f"        tests: {{{', '.join(tests)}}}\n" if tests else ""
    tests = _of_signs(_TESTS, signs)
    yield "".join(["    tests:\n", *tests]) if tests else ""


def _of_signs(lines: Iterable[tuple[str, str]], signs: Sequence[str]) -> list[str]:
    return [line for sign, line in lines if sign in signs]
