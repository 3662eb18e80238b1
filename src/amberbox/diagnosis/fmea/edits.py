"""Write proposals into the text of an ``fmea.yaml``: comments and layout of the person are kept.

Only the characters of a number are replaced; what is new is put beside what is there.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from amberbox.core.yaml_nodes import Node
from amberbox.diagnosis.fmea.learning import Proposal
from amberbox.diagnosis.fmea.parser import child_node

_PLAIN = re.compile(r"[^\s,\[\]{}#:'\"]+")


@dataclass(frozen=True, slots=True)
class _Edit:
    """Replace the characters from ``start`` to ``end``; several at one place are in order."""

    start: int
    end: int
    text: str


def edited(text: str, root: Node, proposals: Sequence[Proposal]) -> tuple[str, list[Proposal]]:
    """Return the text with the proposals in it, and those that a person has to write by hand.

    ``root`` is the tree of the text. A number that is a parameter of a type is left as it is.
    """
    writer = _Writer(text, root)
    left = [proposal for proposal in proposals if not writer.take(proposal)]
    return writer.result(), left


class _Writer:
    """Collects the edits of a text."""

    def __init__(self, text: str, root: Node) -> None:
        self._text, self._root = text, root
        self._newline = "\r\n" if "\r\n" in text else "\n"
        self._edits: list[_Edit] = []
        self._keys: dict[tuple[int, int], tuple[Node, dict[str, str]]] = {}
        self._leaks: dict[str, str] = {}

    def take(self, proposal: Proposal) -> bool:
        """Note a proposal down; return whether it can be written."""
        node, kind = proposal.node, proposal.kind
        if kind == "symptom":
            return node is not None and self._add_symptom(node, proposal.value)
        if kind == "leak" and node is None:
            self._leaks[proposal.symptom] = proposal.value
            return True
        if node is None or (node.mapping is None and kind in ("rate", "leak")):
            return False
        if node.mapping is not None and self._is_parameter(node.mapping.get(kind)):
            return False
        self._keys.setdefault(node.span, (node, {}))[1][kind] = proposal.value
        return True

    def _is_parameter(self, node: Node | None) -> bool:
        return node is not None and "<" in self._text[slice(*node.span)]

    def result(self) -> str:
        """Return the text with all edits."""
        edits = [*self._edits]
        for node, values in self._keys.values():
            edits += self._with_keys(node, values)
        edits += self._with_leaks()
        text = self._text
        for edit in sorted(edits, key=lambda edit: (edit.start, edit.end), reverse=True):
            text = text[: edit.start] + edit.text + text[edit.end :]
        return text

    def _with_keys(self, node: Node, values: Mapping[str, str]) -> Iterable[_Edit]:
        """Yield the edits that set keys of a mapping; a symptom's address becomes a mapping."""
        start, end = node.span
        if node.mapping is None:
            word = self._text[start:end]
            if not _PLAIN.fullmatch(word) and word[0] not in "'\"":
                word = f"'{word.replace(chr(39), 2 * chr(39))}'"
            yield _Edit(start, end, f"{{symptom: {word}, {_pairs(values)}}}")
            return
        new = {key: value for key, value in values.items() if key not in node.mapping}
        for key in values.keys() - new.keys():
            old = node.mapping[key]
            yield _Edit(old.span[0], self._end(old), values[key])
        if new and self._text[start] == "{":
            yield _Edit(end - 1, end - 1, f", {_pairs(new)}" if node.mapping else _pairs(new))
        elif new:
            lines = "".join(f"{key}: {value}{self._indent(start)}" for key, value in new.items())
            yield _Edit(start, start, lines)

    def _indent(self, at: int) -> str:
        """Return a line end and the blanks with which a block at a place goes on."""
        column = at - (self._text.rfind("\n", 0, at) + 1)
        return self._newline + " " * column

    def _add_symptom(self, mode: Node, value: str) -> bool:
        """Add an entry to the symptoms of a mode; return False if it says that nothing shows it."""
        listed = child_node(mode, "symptoms")
        if "unobservable" in (mode.mapping or {}) or mode.mapping is None:
            return False
        if listed is mode:
            keys = self._keys.setdefault(mode.span, (mode, {}))[1]
            before = keys.get("symptoms", "[]")[1:-1]
            keys["symptoms"] = f"[{', '.join(filter(None, (before, value)))}]"
            return True
        if listed.items is None:
            return False
        start = listed.span[0]
        if self._text[start] == "[":
            last = max((self._end(one) for one in listed.items), default=start + 1)
            self._edits.append(_Edit(last, last, f", {value}" if listed.items else value))
        else:
            self._edits.append(_Edit(start, start, f"- {value}{self._indent(start)}"))
        return True

    def _end(self, node: Node) -> int:
        """Return where a node ends; a block has no end of its own but that of its last scalar."""
        parts = [*(node.mapping or {}).values(), *(node.items or ())]
        if not parts or self._text[node.span[0]] in "{[":
            return node.span[1]
        return max(map(self._end, parts))

    def _with_leaks(self) -> Iterable[_Edit]:
        """Yield the edit that adds entries of symptoms with their leak."""
        if not self._leaks:
            return
        node = child_node(self._root, "symptoms")
        entries = {name: f"{{leak: {value}}}" for name, value in self._leaks.items()}
        if node is self._root or node.mapping is None:
            end = len(self._text)
            head = "" if self._text.endswith("\n") or not self._text else self._newline
            lines = "".join(f"  {name}: {one}{self._newline}" for name, one in entries.items())
            yield _Edit(end, end, f"{head}symptoms:{self._newline}{lines}")
        else:
            yield from self._with_keys(node, entries)


def _pairs(values: Mapping[str, str]) -> str:
    return ", ".join(f"{key}: {value}" for key, value in values.items())
