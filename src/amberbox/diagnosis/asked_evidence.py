"""The evidence of providers that the tracker asks, when there may be something new."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import CodeType
from typing import Any, Final

import msgspec

from amberbox.core.clock import NS
from amberbox.core.contracts import (
    AnsweredTest,
    Conflict,
    EvidenceItem,
    EvidenceNeeds,
    EvidenceProvider,
    Finding,
)
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.types import Symptom
from amberbox.diagnosis.diagnose import (
    DiagnosisContext,
    ObservedSituation,
    OpenWindow,
    evidence_providers,
    found_symptoms,
    is_answer,
)
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.status_history import StatusHistory
from amberbox.diagnosis.symptom_presence import Counts

PERIOD_NS: Final = 10 * NS
"""Providers that look back over the record are asked at multiples of this as well."""
RETRY_NS: Final = 300 * NS
READ_AGAIN_NS: Final = 2 * NS
"""Providers of the record alone are not asked again sooner only because symptoms change."""
_MOST = 500
"""Most symptoms of one provider that count; a rule with more answers is a mistake."""
_LONGEST = 200


class AskedEvidence:
    """The providers of a robot, and what each found last; without a window none is asked.

    A provider that fails is left out, with what it has found, and tried again after five minutes.
    """

    def __init__(self, knowledge: Knowledge, open_window: OpenWindow | None = None) -> None:
        self._knowledge = knowledge
        self._open_window = open_window
        self._needs: dict[str, EvidenceNeeds] = {}
        self._providers: dict[str, EvidenceProvider[Knowledge]] = {}
        self._found: dict[str, dict[str, Symptom]] = {}
        self._texts: dict[str, tuple[str, ...]] = {}
        self._answers: dict[str, dict[str, str]] = {}
        self._seen: dict[str, Counts] | None = None
        self._due_ns: int | None = None
        self._statuses = StatusHistory()
        self.left_out: dict[str, str] = {}
        """Why providers are left out, by name."""
        self._retry_ns: dict[str, int] = {}
        self._asked_ns: dict[str, int] = {}
        self._put_off_ns: int | None = None
        self._select()

    def _select(self) -> None:
        """Take all providers that need symptoms and have something to say about this robot."""
        self._providers, self._needs, self.left_out, self._retry_ns = {}, {}, {}, {}
        if self._open_window is None:
            return
        folder = self._open_window(DiagnosisContext(0)).folder
        for name, provider in evidence_providers().items():
            try:
                needs = provider.needs(self._knowledge, folder)
            except Exception as error:  # of a plugin: it must not stop the others
                self.left_out[name] = _reason(error)
                continue
            if needs is not None and needs.symptoms:
                self._providers[name], self._needs[name] = provider, needs

    @property
    def names(self) -> tuple[str, ...]:
        """Return the providers that are asked, those left out for now excepted."""
        return tuple(name for name in self._providers if name not in self.left_out)

    @property
    def is_used(self) -> bool:
        """Return whether there is any provider to ask, now or later."""
        return bool(self._providers)

    @property
    def texts(self) -> tuple[str, ...]:
        """Return the findings that indicate no failure mode, and the providers left out."""
        found = (text for texts in self._texts.values() for text in texts)
        gone = (f"its {name} were left out: {why}" for name, why in self.left_out.items())
        return tuple(dict.fromkeys((*found, *gone)))

    @property
    def answers(self) -> dict[str, str]:
        """Return the results of tests that providers know, by test."""
        return {test: value for found in self._answers.values() for test, value in found.items()}

    @property
    def codes(self) -> frozenset[CodeType]:
        """Return the code of the functions that are called, for a guard against hanging."""
        functions = (getattr(provider, "provide", None) for provider in self._providers.values())
        codes = (getattr(function, "__code__", None) for function in functions)
        return frozenset(code for code in codes if code is not None)

    def begin(self, at_ns: int) -> None:
        """Begin an epoch: what was found is not known any more, and all providers are asked."""
        if self.left_out:
            self._select()
        self._found, self._texts, self._answers, self._seen = {}, {}, {}, None
        self._due_ns = None
        self._asked_ns, self._put_off_ns = {}, None
        self._statuses.begin(at_ns)

    @property
    def _is_timed(self) -> bool:
        return any(needs.history_s > 0 for needs in self._needs.values())

    def receive(self, found: Sequence[object]) -> None:
        """Take the monitors' findings, in order of time."""
        if self._is_timed:
            self._statuses.take(found)

    def forget_before(self, until_ns: int) -> None:
        """Forget what no longer matters after an instant."""
        if self._is_timed:
            self._statuses.forget_before(until_ns)

    def next_ns(self, at_ns: int) -> int | None:
        """Return when to ask next although nothing has changed; None for never."""
        if self._seen is None and self._providers:
            return at_ns + 1
        times_ns = list(self._retry_ns.values())
        if self._put_off_ns is not None:
            times_ns.append(self._put_off_ns)
        if self._is_timed:
            times_ns.append((at_ns // PERIOD_NS + 1) * PERIOD_NS)
        return min(times_ns, default=None)

    def is_due(self, at_ns: int, counting: Mapping[str, Counts]) -> bool:
        """Return whether there may be something new: other symptoms count, or time has passed."""
        if not self._providers:
            return False
        is_late = self._due_ns is not None and at_ns >= self._due_ns
        return is_late or self._of_others(counting) != self._seen

    def _of_others(self, counting: Mapping[str, Counts]) -> dict[str, Counts]:
        own = {name for found in self._found.values() for name in found}
        return {name: of for name, of in counting.items() if of and name not in own}

    def ask(
        self, at_ns: int, situation: ObservedSituation, counting: Mapping[str, Counts]
    ) -> list[Symptom]:
        """Ask all providers; return the symptoms that have come, changed or gone since."""
        assert self._open_window is not None, "without a window no provider is asked"
        self._seen = self._of_others(counting)
        for name in self._found:
            situation = situation.without(name)
        statuses = self._statuses.until(at_ns) if self._is_timed else None
        changes: list[Symptom] = []
        self._put_off_ns = None
        for name, provider in self._providers.items():
            if at_ns < self._retry_ns.get(name, 0) or self._is_put_off(name, at_ns):
                continue
            self._asked_ns[name] = at_ns
            case = DiagnosisContext(at_ns, situation, statuses=statuses)
            try:
                items = tuple(provider.provide(self._knowledge, self._open_window(case)))
                taken = self._taken(name, items, at_ns)
                others = {one.id for one in situation.symptoms if one.source != name}
                found = {one.id: one for one in taken if one.id not in others}
            except Exception as error:  # of a plugin: it must not stop the others
                changes += self._leave_out(name, error, at_ns)
                continue
            self._retry_ns.pop(name, None)
            self.left_out.pop(name, None)
            situation = situation.with_items(found.values())
            changes += self._changed(name, found, at_ns)
        self._due_ns = self.next_ns(at_ns)
        return changes

    def _is_put_off(self, name: str, at_ns: int) -> bool:
        """Return whether a provider has read the record a moment ago; it is asked a bit later."""
        needs, before_ns = self._needs[name], self._asked_ns.get(name)
        again_ns = 0 if before_ns is None else before_ns + READ_AGAIN_NS
        if needs.reads_symptoms or not needs.history_s or at_ns >= again_ns:
            return False
        self._put_off_ns = min(self._put_off_ns or again_ns, again_ns)
        return True

    def _taken(self, name: str, items: Sequence[EvidenceItem], at_ns: int) -> list[Symptom]:
        """Return the symptoms that a provider found, and keep its texts and its tests.

        Raises UsageError for a conflict of failure modes that do not exist.
        """
        for item in items:
            if isinstance(item, Conflict):
                _check_conflict(item, self._knowledge)
        found = [replace(one, source=name) for one in found_symptoms(items, at_ns)]
        texts = tuple(item.text for item in items if isinstance(item, Finding))
        if len(found) > _MOST:
            texts = (*texts, f"{name}: only {_MOST} of {len(found):,} findings count")
        self._texts[name] = texts
        given = (item for item in items if isinstance(item, AnsweredTest))
        self._answers[name] = {
            item.test: item.outcome
            for item in given
            if is_answer(self._knowledge, item.test, item.outcome)
        }
        return found[:_MOST]

    def _changed(self, name: str, found: dict[str, Symptom], at_ns: int) -> list[Symptom]:
        before, self._found[name] = self._found.get(name, {}), found
        gone = [
            Symptom(known.id, "absent", known.address, None, at_ns, source=name)
            for known in before.values() if known.id not in found
        ]  # fmt: skip
        new = [
            replace(one, confirmed_ns=at_ns)
            for one in found.values() if _content(one) != _content(before.get(one.id))
        ]  # fmt: skip
        return [*gone, *new]

    def _leave_out(self, name: str, error: Exception, at_ns: int) -> list[Symptom]:
        """Do without a provider for a while; what it has found is unknown."""
        self.left_out[name] = _reason(error)
        self._retry_ns[name] = at_ns + RETRY_NS
        self._texts.pop(name, None)
        self._answers.pop(name, None)
        known = self._found.pop(name, {})
        return [
            Symptom(symptom.id, "unknown", symptom.address, None, at_ns, source=name)
            for symptom in known.values()
        ]

    def snapshot(self) -> dict[str, Any]:
        """Return all of it as JSON."""
        return {
            "found": msgspec.to_builtins(self._found),
            "texts": self._texts,
            "answers": self._answers,
            "seen": self._seen,
            "due_ns": self._due_ns,
            "left_out": self.left_out,
            "retry_ns": self._retry_ns,
            "asked_ns": self._asked_ns,
            "put_off_ns": self._put_off_ns,
            "statuses": self._statuses.snapshot(),
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from what ``snapshot`` returned."""
        self._found = msgspec.convert(snapshot["found"], dict[str, dict[str, Symptom]])
        self._texts = msgspec.convert(snapshot["texts"], dict[str, tuple[str, ...]])
        self._answers = dict(snapshot["answers"])
        self._seen, self._due_ns = snapshot["seen"], snapshot["due_ns"]
        self._statuses.resume(snapshot["statuses"])
        self.left_out = dict(snapshot["left_out"])
        self._retry_ns = dict(snapshot["retry_ns"])
        self._asked_ns = dict(snapshot.get("asked_ns", {}))  # not written by earlier versions
        self._put_off_ns = snapshot.get("put_off_ns")


def _check_conflict(conflict: Conflict, knowledge: Knowledge) -> None:
    known = knowledge.model.mode_places
    unknown = sorted(fault for fault in conflict.faults if fault not in known)
    if unknown or not conflict.faults:
        what = f"'{unknown[0]}' is no failure mode" if unknown else "a conflict of nothing"
        raise UsageError(f"{what}, but it is said to be proven")


def _content(symptom: Symptom | None) -> object:
    """Return what of a symptom is evidence: not when it was asked for."""
    if symptom is None:
        return None
    return symptom.state, symptom.strength, symptom.evidence, symptom.size


def _reason(error: Exception) -> str:
    text = error.what if isinstance(error, AmberboxError) else f"{type(error).__name__}: {error}"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
