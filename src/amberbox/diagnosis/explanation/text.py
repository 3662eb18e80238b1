"""An explanation as text: a first paragraph for everybody, then one section per question."""

from __future__ import annotations

import re
import shlex
import textwrap
from collections.abc import Iterator, Sequence

from amberbox.core.sureness import percent
from amberbox.diagnosis.explanation.explanation import (
    Branch,
    Explanation,
    Fault,
    Group,
    Member,
    Possibility,
    Seen,
    Step,
)
from amberbox.diagnosis.explanation.headline import NOTHING, chance
from amberbox.diagnosis.explanation.why import by_reasons
from amberbox.diagnosis.explanation.words import (
    WORTH_TELLING,
    capital,
    clock,
    count,
    date_and_clock,
    later,
    sentence,
)

WIDTH = 88
MEASURED = 3
"""How many addresses are told of what one symptom was measured from."""

SURE_ENOUGH = 0.8
"""How sure an answer to a test must make a fault for its remedy to be told."""

NOT_FOLLOWING = "Seen; it does not follow from any fault that leads, and may be a false alarm:"


def as_text(explanation: Explanation, *, details: bool = True) -> str:
    """Write an explanation as text of at most 88 columns; without ``details`` for laymen."""
    lines = [*_wrapped(_first_paragraph(explanation)), ""]
    for title, body in _sections(explanation):
        lines += [title, *body, ""]
    if details:
        lines += ["Details", *(_line(text, "  ") for text in explanation.details), ""]
    return "\n".join(lines)


def _first_paragraph(explanation: Explanation) -> str:
    """Say in a few sentences what is broken, whether the robot can be used, what to do."""
    if explanation.state == "healed":
        return explanation.headline
    said = (f"{m.name} says: {m.text}" for m in explanation.members if m.state == "open")
    use = f"Can the robot be used? {sentence(explanation.use.text)}"
    next_step = f"Next: {sentence(explanation.next.text)}"
    return " ".join((explanation.headline, *said, use, next_step))


def _sections(explanation: Explanation) -> Iterator[tuple[str, list[str]]]:
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
    yield "Do this next", list(_next(explanation.next))


def _broken(explanation: Explanation) -> Iterator[str]:
    yield f"  {explanation.robot}, {date_and_clock(explanation.at_ns)}"
    broken = explanation.broken
    if broken is None:
        yield from _paragraph(sentence(NOTHING))
        return
    many = len(broken.members) > 1
    if many:
        yield from _paragraph(f"One of {count(len(broken.members))}; nothing tells them apart yet:")
    for member in broken.members:
        yield from _possibility(member, f", {percent(member.probability)}" if many else "")


def _possibility(member: Possibility, number: str) -> Iterator[str]:
    if not member.faults:
        yield from _item(f"{capital(member.text)}: what was seen needs no fault{number}")
    elif len(member.faults) == 1:
        yield from _item(f"{capital(member.text)} ({member.faults[0].id}){number}")
        yield from _cause(member.faults[0], "may come from:")
    else:
        yield from _item(f"{capital(member.text)}{number}")
        for fault in member.faults:
            yield from _cause(fault, f"{fault.id} may come from:") or [_line(fault.id, "    ")]


def _cause(fault: Fault, title: str) -> list[str]:
    return [_line(f"{title} {fault.cause}", "    ")] if fault.cause else []


def _cleared(explanation: Explanation) -> Iterator[str]:
    for fault in explanation.cleared:
        since = "" if fault.gone_ns is None else f", since {clock(fault.gone_ns)}"
        yield from _item(f"{capital(fault.text)} ({fault.id}){since}")


def _members(members: Sequence[Member]) -> Iterator[str]:
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
        yield from _paragraph(f"{capital(sure.word)}{of}: {chance(sure)}.")
    if sure.note:
        yield from _paragraph(sentence(sure.note))


def _why(explanation: Explanation) -> Iterator[str]:
    for reasons, all_seen in by_reasons(explanation.because, explanation.broken).items():
        yield from _paragraph(f"{capital('; and '.join(reasons))}:")
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


def _seen(seen: Seen) -> Iterator[str]:
    when = ""
    if seen.onset_ns is not None:
        after = "" if seen.after_s is None else f" ({later(seen.after_s)})"
        when = f"{clock(seen.onset_ns)}{after} "
    gone = "" if seen.gone_ns is None else f"; gone since {clock(seen.gone_ns)}"
    yield from _item(f"{when}{seen.text}{gone}")
    yield _line(f"{seen.address}{_measured_from(seen)}", "    ")


def _measured_from(seen: Seen) -> str:
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


def _others(others: Sequence[Group]) -> Iterator[str]:
    worth = [group for group in others if group.probability >= WORTH_TELLING]
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


def _next(step: Step) -> Iterator[str]:
    for action in step.make_safe:
        yield from _paragraph(f"First, make it safe: {action.text} (it may be: {action.why}).")
    yield from _paragraph(sentence(f"Then: {step.then}" if step.make_safe else step.text))
    if step.test:
        yield _line(_effort(step), "  ")
        yield from _paragraph("What the answers would mean:")
    told = set[str]()
    for branch in step.answers:
        yield from _branch(branch)
        told.update(_helps(branch))
    rest = [remedy for remedy in step.remedies if remedy not in told]
    if step.test and rest:
        yield from _paragraph(f"What helps, once it is sure: {'; or '.join(rest)}.")


def _effort(step: Step) -> str:
    takes = f"about {step.takes}" if step.takes else ""
    risk = f"{step.risk} risk of doing harm" if step.risk else "no risk"
    splits = "tells them apart" if step.splits else ""
    parts = [step.by, takes, risk, splits]
    return f"{capital(', '.join(part for part in parts if part))} (test {step.test})."


def _branch(branch: Branch) -> Iterator[str]:
    helps = "".join(f"; then: {remedy}" for remedy in _helps(branch))
    what = f'"{branch.answer}" ({percent(branch.probability)}): {branch.leads}'
    yield from _item(f"{what}, {percent(branch.then)}{helps}")


def _helps(branch: Branch) -> tuple[str, ...]:
    """Return the remedy if the answer makes sure enough that it is the right one."""
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
