"""An explanation as text: a first paragraph for everybody, then one section per question."""

from __future__ import annotations

import re
import shlex
import textwrap
from collections.abc import Iterator, Mapping, Sequence

from amberbox.core.units import percent
from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.report.explain import NOTHING, chance
from amberbox.diagnosis.report.explanation import (
    AnswerBranch,
    CausalPath,
    ExplainedFault,
    ExplainedGroup,
    Explanation,
    MemberDiagnosis,
    NextStep,
    SeenSymptom,
)
from amberbox.diagnosis.report.wording import (
    WORTH_SHOWING,
    capitalize,
    clock,
    date_and_clock,
    delay_text,
    join_with_or,
    number_word,
    run_command,
    sentence,
)

DIRECT = "this is how the fault shows"
EACH = "this is how each of them shows"
OTHER = "nothing that the FMEA knows explains this better"


def group_by_reasons(
    because: Sequence[SeenSymptom], broken: ExplainedGroup | None
) -> Mapping[tuple[str, ...], Sequence[SeenSymptom]]:
    """Return the symptoms by the reasons they have in common, in order of the first of each."""
    found: dict[tuple[str, ...], list[SeenSymptom]] = {}
    for seen in because:
        found.setdefault(reasons(seen, broken), []).append(seen)
    return found


def reasons(seen: SeenSymptom, broken: ExplainedGroup | None) -> tuple[str, ...]:
    """Return why a symptom follows from the cause: directly, or by lost functions."""
    faults = {
        fault.id: fault.text for m in (broken.members if broken else ()) for fault in m.faults
    }
    direct = {way.fault for way in seen.ways if not way.via}
    return (*_direct(direct, faults), *_by_loss([way for way in seen.ways if way.via], faults))


def _direct(direct: set[str], faults: Mapping[str, str]) -> Iterator[str]:
    if faults.keys() == {UNKNOWN}:
        yield OTHER
    elif direct and direct == faults.keys():
        yield DIRECT if len(faults) == 1 else EACH
    elif direct:
        texts = [text for name, text in faults.items() if name in direct]
        yield f"this is how it shows: {join_with_or(texts, len(texts))}"


def _by_loss(ways: Sequence[CausalPath], faults: Mapping[str, str]) -> Iterator[str]:
    """Yield a causal path once that several faults have in common."""
    starts: dict[str, list[str]] = {}
    for way in ways:
        starts.setdefault(way.text, []).append(way.fault)
    for text, of in starts.items():
        if set(of) == faults.keys():
            yield text if len(of) == 1 else f"each of them -> {text}"
        else:
            yield from (f"{faults.get(fault, fault)} -> {text}" for fault in of)


WIDTH = 88
MEASURED = 3  # how many addresses are shown of what one symptom was measured from

SURE_ENOUGH = 0.8  # how probable an answer to a test must make a fault for its remedy to be shown

NOT_FOLLOWING = "Seen; it does not follow from any fault that leads, and may be a false alarm:"


def as_text(explanation: Explanation, *, details: bool = True, folder: str = "FOLDER") -> str:
    """Write an explanation as text of at most 88 columns; without ``details`` for laymen.

    ``folder`` is the robot folder in commands that it names.
    """
    lines = [*_wrapped(_first_paragraph(explanation)), ""]
    for title, body in _sections(explanation, folder):
        lines += [title, *body, ""]
    if details:
        lines += ["Details", *(_line(text, "  ") for text in explanation.details), ""]
    return "\n".join(lines)


def _first_paragraph(explanation: Explanation) -> str:
    """Return in a few sentences what is broken, whether the robot can be used, what to do."""
    if explanation.state == "healed":
        return explanation.headline
    members = (f"{m.name} says: {m.text}" for m in explanation.members if m.state == "open")
    use = f"Can the robot be used? {sentence(explanation.use.text)}"
    next_step = f"Next: {sentence(explanation.next.text)}"
    return " ".join((explanation.headline, *members, use, next_step))


def _sections(explanation: Explanation, folder: str) -> Iterator[tuple[str, list[str]]]:
    was = explanation.state == "healed"
    yield "What was broken" if was else "What is broken", list(_broken(explanation))
    if explanation.cleared:
        yield "What was broken and shows no more", list(_cleared(explanation))
    if explanation.members:
        yield "What the robots say themselves", list(_members(explanation.members))
    yield "How sure", list(_sure(explanation))
    yield "Why", list(_why(explanation))
    yield "What speaks against it", list(_against(explanation))
    yield "What else it may be", list(_others(explanation.others))
    yield "Could the robot be used" if was else "Can the robot be used", list(_use(explanation))
    yield "Do this next", list(_next(explanation.next, folder))


def _broken(explanation: Explanation) -> Iterator[str]:
    yield f"  {explanation.robot}, {date_and_clock(explanation.at_ns)}"
    broken = explanation.broken
    if broken is None:
        yield from _paragraph(sentence(NOTHING))
        return
    many = len(broken.members) > 1
    if many:
        yield from _paragraph(
            f"One of {number_word(len(broken.members))}; nothing tells them apart yet:"
        )
    for member in broken.members:
        number = f", {percent(member.probability)}" if many else ""
        if not member.faults:
            yield from _item(f"{capitalize(member.text)}: what was seen needs no fault{number}")
        elif len(member.faults) == 1:
            yield from _item(f"{capitalize(member.text)} ({member.faults[0].id}){number}")
            yield from _cause(member.faults[0], "may come from:")
        else:
            yield from _item(f"{capitalize(member.text)}{number}")
            for fault in member.faults:
                yield from _cause(fault, f"{fault.id} may come from:") or [_line(fault.id, "    ")]


def _cause(fault: ExplainedFault, title: str) -> list[str]:
    return [_line(f"{title} {fault.cause}", "    ")] if fault.cause else []


def _cleared(explanation: Explanation) -> Iterator[str]:
    for fault in explanation.cleared:
        since = "" if fault.gone_ns is None else f", since {clock(fault.gone_ns)}"
        yield from _item(f"{capitalize(fault.text)} ({fault.id}){since}")


def _members(members: Sequence[MemberDiagnosis]) -> Iterator[str]:
    for member in members:
        use = f" Can it be used? {sentence(member.use)}" if member.use else ""
        after = f" Next: {sentence(member.next)}" if member.next else ""
        yield from _item(f"{member.name}: {member.text}{use}{after}")
        yield _line(f"more: amberbox diagnose {shlex.quote(member.where)}", "    ")


def _sure(explanation: Explanation) -> Iterator[str]:
    sure = explanation.sure
    if explanation.broken is None:
        yield from _paragraph("There is no answer to be sure of.")
    else:
        of = " that it is one of these" if len(explanation.broken.members) > 1 else ""
        yield from _paragraph(f"{capitalize(sure.word)}{of}: {chance(sure)}.")
    if sure.note:
        yield from _paragraph(sentence(sure.note))


def _why(explanation: Explanation) -> Iterator[str]:
    for reasons, all_seen in group_by_reasons(explanation.because, explanation.broken).items():
        yield from _paragraph(f"{capitalize('; and '.join(reasons))}:")
        for seen in all_seen:
            yield from _seen(seen)
    yield from _not_explained(explanation)


def _not_explained(explanation: Explanation) -> Iterator[str]:
    if explanation.unexplained:
        because = explanation.because
        title = "Seen as well, but it does not follow from this:" if because else NOT_FOLLOWING
        yield from _paragraph(title)
        for seen in explanation.unexplained:
            yield from _seen(seen)
    if explanation.unknown:
        yield from _paragraph(f"Seen, but not in the FMEA: {', '.join(explanation.unknown)}.")
    if explanation.blocked:
        yield from _paragraph("Seen, but not counted, as what it depends on is not well:")
        for seen in explanation.blocked:
            yield from _item(f"{seen.text} ({seen.address})")


def _seen(seen: SeenSymptom) -> Iterator[str]:
    when = ""
    if seen.onset_ns is not None:
        after = "" if seen.after_s is None else f" ({delay_text(seen.after_s)})"
        when = f"{clock(seen.onset_ns)}{after} "
    gone = "" if seen.gone_ns is None else f"; gone since {clock(seen.gone_ns)}"
    yield from _item(f"{when}{seen.text}{gone}")
    yield _line(f"{seen.address}{_measured_from(seen)}", "    ")


def _measured_from(seen: SeenSymptom) -> str:
    addresses = [address for address in seen.measured_from if address != seen.address]
    if not addresses:
        return ""
    more = len(addresses) - MEASURED
    tail = f" and {more} more" if more > 0 else ""
    return f", measured from {', '.join(addresses[:MEASURED])}{tail}"


def _against(explanation: Explanation) -> Iterator[str]:
    if not explanation.against:
        yield from _paragraph("Nothing that was looked at.")
        return
    yield from _paragraph("This should show as well, and does not:")
    for seen in explanation.against:
        yield from _item(f"{seen.text} ({seen.address})")


def _others(others: Sequence[ExplainedGroup]) -> Iterator[str]:
    worth = [group for group in others if group.probability >= WORTH_SHOWING]
    for group in worth:
        yield from _item(f"{percent(group.probability)}: {group.text}")
    if not worth:
        yield from _paragraph("Nothing: no other possibility that was looked at has 1 %.")


def _use(explanation: Explanation) -> Iterator[str]:
    use = explanation.use
    severity = f" (severity: {use.severity})" if use.severity else ""
    yield from _paragraph(f"{sentence(use.text)[:-1]}{severity}.")
    if use.lost:
        yield from _paragraph("What it can no longer do:")
        for lost in use.lost:
            yield from _item(f"{lost.text} ({lost.id}, {lost.severity})")
    if use.careful:
        yield from _paragraph(sentence(use.careful))


def _next(step: NextStep, folder: str) -> Iterator[str]:
    for action in step.make_safe:
        yield from _paragraph(f"First, make it safe: {action.text} (it may be: {action.why}).")
    yield from _paragraph(sentence(f"Then: {step.then}" if step.make_safe else step.text))
    if step.test:
        yield _line(_effort(step), "  ")
        if step.run:
            yield f"  To run it: {run_command(step.kind, step.run, folder)}"
        yield from _paragraph("What the answers would mean:")
    shown = set[str]()
    for branch in step.answers:
        helps = _helps(branch)
        what = f'"{branch.answer}" ({percent(branch.probability)}): {branch.leads}'
        then = "".join(f"; then: {remedy}" for remedy in helps)
        yield from _item(f"{what}, {percent(branch.then)}{then}")
        shown.update(helps)
    rest = [remedy for remedy in step.remedies if remedy not in shown]
    if step.test and rest:
        yield from _paragraph(f"What helps, once it is sure: {'; or '.join(rest)}.")


def _effort(step: NextStep) -> str:
    takes = f"about {step.takes}" if step.takes else ""
    risk = f"{step.risk} risk of doing harm" if step.risk else "no risk"
    splits = "tells them apart" if step.splits else ""
    parts = [step.by, takes, risk, splits]
    return f"{capitalize(', '.join(part for part in parts if part))} (test {step.test})."


def _helps(branch: AnswerBranch) -> tuple[str, ...]:
    """Return the remedy if the answer makes it certain enough that it is the right one."""
    return (branch.remedy,) if branch.remedy and branch.then >= SURE_ENOUGH else ()


def _paragraph(text: str) -> list[str]:
    return _wrapped(text, "  ", "  ")


def _item(text: str) -> list[str]:
    return _wrapped(text, "  - ", "    ")


def _line(text: str, indent: str) -> str:
    indent += " " * (len(text) - len(text.lstrip()))
    return "\n".join(_wrapped(text.lstrip(), indent, f"{indent}  "))


def _wrapped(text: str, first: str = "", further: str = "") -> list[str]:
    """Break text into lines, but not between a number and its percent sign."""
    lines = textwrap.wrap(
        re.sub(r"(?<=\d) %", "\u00a0%", text),
        WIDTH,
        initial_indent=first,
        subsequent_indent=further,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace("\u00a0", " ") for line in lines]
