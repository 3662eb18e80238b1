"""Findings of other engines mapped to the failure modes they indicate, in every instance."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import product
from math import prod
from typing import Final

from amberbox.core.errors import Problem, did_you_mean
from amberbox.core.expression import Expression
from amberbox.core.yaml_nodes import Node
from amberbox.diagnosis.covering.model import Link, Sign
from amberbox.diagnosis.fmea.model import FailureMode, FindingMapping, Fmea, FmeaReferences
from amberbox.diagnosis.fmea.parser import DefaultsFile, FindingFile, ParsedFmea, child_node
from amberbox.diagnosis.prolog.syntax import Sentence, read_goal, write
from amberbox.diagnosis.prolog.terms import Key, RuleFault, key_of, show_key, unify

_VARIABLE = re.compile(r"<([A-Za-z_]\w*)>", re.ASCII)
RULE: Final = "rule:"
"""Begins the id of a finding of rules."""
COMBINED: Final = "combined."
"""Begins the ids ``combined.values.ITEM`` and ``combined.timing.ITEM``: detectors have an alarm."""
_RARELY = 0.01  # that a failure mode shows where none of its symptoms is measured
_KINDS = ("values", "timing")
_MOST = 5_000  # most instances of one finding; more are a mistake in maps_to

Values = Mapping[str, str]  # values of variables by name


def map_findings(
    sheet: ParsedFmea, modes: Collection[str], known: FmeaReferences | None, problems: list[Problem]
) -> tuple[FindingMapping, ...]:
    """Return the findings of the file; report their errors, and findings without failure modes."""
    found = [_mapped(entry, sheet.file.defaults) for _, entry in sheet.findings]
    for number, (node, _) in enumerate(sheet.findings):
        problems.extend(_problems(found[number], node, f"findings[{number}]", modes, known))
    problems.extend(_unmapped(found, known))
    return tuple(found)


def _mapped(entry: FindingFile, defaults: DefaultsFile) -> FindingMapping:
    return FindingMapping(
        entry.rule,
        entry.finding,
        tuple(entry.maps_to),
        defaults.detects if entry.detects is None else entry.detects,
        defaults.leak if entry.leak is None else entry.leak,
        entry.proves,
        entry.description,
        0.0 if entry.rule else defaults.hold_s,  # the facts of a rule are remembered already
        entry.leak is not None,
    )


def unusual_findings(
    modes: Mapping[str, FailureMode],
    conditions: Mapping[str, Expression],
    known: FmeaReferences | None,
    defaults: DefaultsFile,
    mapped: Collection[FindingMapping] = (),
) -> tuple[FindingMapping, ...]:
    """Return the findings that detectors have an alarm about an item, where detectors run.

    Values of the item, and the times of its messages, are two. The causes of each are the failure
    modes with a symptom that is measured from them, each as probable as one of these symptoms;
    without any, those of all components whose monitors read it, though each is improbable: it is
    rather a fault of theirs that is not in the file. Those that the file has ``mapped`` are left
    out.
    """
    detected = known.detected if known is not None else {}
    misses: dict[str, dict[str, float]] = {}
    for mode in modes.values() if detected else ():
        for link in mode.symptoms:
            for finding in _unusual_by(link.symptom, conditions, detected):
                of = misses.setdefault(finding, {})
                of[mode.id] = of.get(mode.id, 1.0) * (1.0 - link.detects)
    measured = {*misses}
    for output, addresses in detected.items():
        component = output.partition("/")[0]
        own = [mode.id for mode in modes.values() if mode.component == component]
        items = {_item_of(address) for address in addresses} if own else ()
        for finding in (f"{COMBINED}{kind}.{item}" for item in items for kind in _KINDS):
            if finding not in measured:
                misses.setdefault(finding, {}).update(dict.fromkeys(own, 1.0 - _RARELY))
    return tuple(
        FindingMapping(
            finding=finding,
            maps_to=tuple(name for name in of if of[name] == miss),
            detects=1.0 - miss,
            leak=0.0,  # the calibration states it
            description=_unusual_text(finding),
            hold_s=defaults.hold_s,
        )
        for finding, of in sorted(misses.items())
        if finding not in {one.finding for one in mapped}
        for miss in sorted({*of.values()})
    )


def _unusual_by(
    symptom: str,
    conditions: Mapping[str, Expression],
    detected: Mapping[str, Collection[str]],
) -> set[str]:
    """Return the findings about what a symptom is measured from."""
    condition = conditions.get(symptom)
    names = condition.addresses() if condition else (symptom,)
    read = (detected.get(name, () if "/" in name else (name,)) for name in names)
    return {
        f"{COMBINED}{'values' if '.' in address else 'timing'}.{_item_of(address)}"
        for addresses in read
        for address in addresses
    }


def _unusual_text(finding: str) -> str:
    kind, item = finding.removeprefix(COMBINED).split(".", 1)
    return f"detectors find {'values' if kind == 'values' else 'the timing'} of {item} unusual"


def readers_of(known: FmeaReferences | None) -> dict[str, frozenset[str]]:
    """Return the components whose monitors read an address, or an item of it."""
    found: dict[str, set[str]] = {}
    for output, addresses in (known.detected if known is not None else {}).items():
        for address in addresses:
            for name in (address, _item_of(address)):
                found.setdefault(name, set()).add(output.partition("/")[0])
    return {name: frozenset(components) for name, components in found.items()}


def _item_of(address: str) -> str:
    return address.partition(".")[0]


def _problems(
    of: FindingMapping, node: Node, where: str, modes: Collection[str], known: FmeaReferences | None
) -> Iterator[Problem]:
    variables: Collection[str] = _VARIABLE.findall(of.finding)
    if of.goal:
        place = child_node(node, "rule")
        try:
            sentence = read_goal(of.goal)
        except RuleFault as fault:
            yield place.problem(f"{where}.rule", fault.what, fault.hint)
            return
        yield from _goal_problems(sentence, place, where, known)
        variables = sentence.names
    for number, pattern in enumerate(of.maps_to):
        at = child_node(node, "maps_to", number)
        yield from _pattern_problems(pattern, at, f"{where}.maps_to[{number}]", variables, modes)
    if not of.maps_to:
        what = "speaks for no failure mode: it is shown, but moves nothing"
        yield node.problem(where, what, is_error=False)
    count = prod(map(len, _options(of, modes).values()))
    if count > _MOST:
        what = f"stands for {count:,} findings, more than {_MOST:,}"
        yield child_node(node, "maps_to").problem(f"{where}.maps_to", what, "use fewer variables")


def _goal_problems(
    sentence: Sentence, place: Node, where: str, known: FmeaReferences | None
) -> Iterator[Problem]:
    key = key_of(sentence.term)
    if key is None or key[0] in (",", ";", "->", "\\+"):
        what = "is not one goal: write a rule for it and name its head here"
        yield place.problem(f"{where}.rule", what)
    elif known is not None and known.predicates is not None and key not in known.predicates:
        names = sorted({name for name, count in known.predicates if count == key[1]})
        what = f"there is no rule {show_key(key)}{did_you_mean(key[0], names)}"
        hint = "the rules are read from rules/*.pl in the robot's folder"
        yield place.problem(f"{where}.rule", what, hint)


def _pattern_problems(
    pattern: str, node: Node, where: str, variables: Collection[str], modes: Collection[str]
) -> Iterator[Problem]:
    strange = [name for name in _VARIABLE.findall(pattern) if name not in variables]
    for name in strange:
        what = f"<{name}> is no variable of it{did_you_mean(name, variables)}"
        yield node.problem(where, what)
    if not strange and not any(_expression(pattern).fullmatch(mode) for mode in modes):
        what = f"there is no failure mode '{pattern}'{did_you_mean(pattern, modes)}"
        yield node.problem(where, what, "write COMPONENT#MODE, or <Variable>#MODE")


def _unmapped(found: Sequence[FindingMapping], known: FmeaReferences | None) -> Iterator[Problem]:
    """Yield a note for each file about heads of rules that lead to no finding."""
    named = {key for of in found if of.goal and (key := _key(of.goal)) is not None}
    left: dict[str, list[tuple[int, Key]]] = {}
    for key, (file, line) in (known.heads if known is not None else {}).items():
        if key not in named:
            left.setdefault(file, []).append((line, key))
    for file, heads in left.items():
        names = ", ".join(show_key(key) for _, key in sorted(heads))
        what = f"answers of {names} are not used in a diagnosis: no finding of fmea.yaml names them"
        yield Problem(file, min(heads)[0], "findings", what, is_error=False)


def _key(goal: str) -> Key | None:
    try:
        return key_of(read_goal(goal).term)
    except RuleFault:
        return None


def _expression(pattern: str) -> re.Pattern[str]:
    """Turn a pattern of addresses into a regular expression with a group for each variable."""
    parts, known = [], set[str]()
    pieces = [*_VARIABLE.split(pattern), ""]
    for text, name in zip(pieces[::2], pieces[1::2], strict=True):
        parts.append(re.escape(text))
        if name:
            parts.append(f"(?P={name})" if name in known else f"(?P<{name}>[^#]+)")
            known.add(name)
    return re.compile("".join(parts))


def _options(of: FindingMapping, modes: Collection[str]) -> dict[str, list[str]]:
    """Return the values that each variable of ``maps_to`` may have."""
    found: dict[str, dict[str, None]] = {}
    for pattern in of.maps_to:
        for name in _VARIABLE.findall(pattern):
            found.setdefault(name, {})
        expression = _expression(pattern)
        for match in filter(None, map(expression.fullmatch, modes)):
            for name, value in match.groupdict().items():
                found[name][value] = None
    return {name: list(values) for name, values in found.items()}


def finding_instances(
    of: FindingMapping, modes: Collection[str]
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield the symptom and the failure modes of each instance that the analysis can name."""
    options = _options(of, modes)
    for values in product(*options.values()):
        named = dict(zip(options, values, strict=True))
        faults = faults_of(of, named, modes)
        if faults:
            yield symptom_of(of, named), faults


def faults_of(of: FindingMapping, values: Values, modes: Collection[str]) -> tuple[str, ...]:
    """Return the failure modes that a finding indicates, given the values of its variables."""
    names = (_filled(pattern, values) for pattern in of.maps_to)
    return tuple(dict.fromkeys(name for name in names if name in modes))


def symptom_of(of: FindingMapping, values: Values) -> str:
    """Return the id of the symptom: ``rule:GOAL``, or that of the detector's finding.

    Variables that ``maps_to`` does not name are written ``_``: all their values give one symptom.
    """
    if not of.goal:
        return _filled(of.finding, values)
    named = {name for pattern in of.maps_to for name in _VARIABLE.findall(pattern)}
    sentence = read_goal(of.goal)
    for name in named & sentence.names.keys() & values.keys():
        sentence.names[name].ref = values[name]
    return f"{RULE}{write(sentence.term)}"


def text_of(fmea: Fmea, symptom: str) -> str:
    """Return the text of a symptom that is a finding; empty for any other."""
    for of in fmea.all_findings:
        if _is_of(of, symptom):
            origin = f"rule {symptom.removeprefix('rule:')}" if of.goal else f"finding {symptom}"
            return f"{of.description} ({origin})" if of.description else origin
    return ""


def causes_of(fmea: Fmea, symptom: str) -> dict[str, float]:
    """Return the failure modes that a finding indicates, each with its detection probability.

    It is 1 for those of which a finding proves that one is there.
    """
    if symptom in fmea.symptoms or not any(_is_of(of, symptom) for of in fmea.all_findings):
        return {}
    proven = proven_faults(fmea).get(symptom)
    if proven is not None:
        return dict.fromkeys(sorted(proven), 1.0)
    return {link.cause: link.detects for link in finding_signs(fmea)[1] if link.symptom == symptom}


def _is_of(of: FindingMapping, symptom: str) -> bool:
    """Return whether a symptom is an instance of a finding."""
    if not of.goal:
        return _expression(of.finding).fullmatch(symptom) is not None
    if not symptom.startswith(RULE):
        return False
    return unify(read_goal(of.goal).term, read_goal(symptom.removeprefix(RULE)).term, [])


def _filled(pattern: str, values: Values) -> str:
    return _VARIABLE.sub(lambda match: values.get(match[1], match[0]), pattern)


def finding_signs(fmea: Fmea) -> tuple[tuple[Sign, ...], tuple[Link, ...]]:
    """Return the symptoms that findings are, and their causes; none can be read on demand."""
    found = list(_symptoms(fmea))
    signs = {name: Sign(name, of.leak, None) for name, of, _ in found}
    new = [sign for name, sign in signs.items() if name not in fmea.symptoms]
    links = [Link(mode, name, of.detects) for name, of, faults in found for mode in faults]
    return tuple(new), tuple(links)


def named_by_findings(fmea: Fmea) -> frozenset[str]:
    """Return the failure modes that some finding indicates."""
    patterns = [_expression(pattern) for of in fmea.findings for pattern in of.maps_to]
    return frozenset(mode for mode in fmea.modes if any(p.fullmatch(mode) for p in patterns))


def finding_holds(fmea: Fmea) -> dict[str, float]:
    """Return for how long each finding is remembered after it has gone, seconds, by its id."""
    return {
        name: of.hold_s for of in fmea.all_findings for name, _ in finding_instances(of, fmea.modes)
    }


def proven_faults(fmea: Fmea) -> dict[str, frozenset[str]]:
    """Return the failure modes of which one is present for sure, by the finding that proves it."""
    return {
        name: frozenset(faults)
        for of in fmea.findings if of.proves
        for name, faults in finding_instances(of, fmea.modes)
    }  # fmt: skip


def faults_by_finding(fmea: Fmea) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each finding, those that prove included, and the failure modes that it indicates."""
    for of in fmea.all_findings:
        yield from finding_instances(of, fmea.modes)


def _symptoms(fmea: Fmea) -> Iterator[tuple[str, FindingMapping, tuple[str, ...]]]:
    for of in fmea.all_findings:
        for name, faults in finding_instances(of, fmea.modes) if not of.proves else ():
            yield name, of, faults
