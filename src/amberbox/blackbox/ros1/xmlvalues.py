"""Reads XML-RPC answers with the C parser of ElementTree.

The box asks the master for the system state every second; on a large robot that is 100 kB, and
reading it with the standard library takes more than twice the time.
"""

from __future__ import annotations

import xmlrpc.client
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

Element = ElementTree.Element

MOST_BYTES = 2 << 20
"""Of an answer; the state of a large robot's master has 100 kB."""
DEEPEST = 32
"""Values in values; those of ROS are four deep."""


class AnswerParser:
    """What ``xmlrpc.client.Transport`` feeds an answer to."""

    def __init__(self) -> None:
        self._parser = ElementTree.XMLParser()
        self._size = 0
        self.root: Element | None = None

    def feed(self, data: bytes) -> None:
        """Take a piece of the answer; raise ValueError when there is too much of it."""
        self._size += len(data)
        if self._size > MOST_BYTES:
            raise ValueError(f"an answer of more than {MOST_BYTES} bytes")
        self._parser.feed(data)

    def close(self) -> None:
        """Take the end of the answer; raise ElementTree.ParseError if it is no XML."""
        self.root = self._parser.close()


class AnswerReader:
    """What ``xmlrpc.client.Transport`` asks for the values of an answer."""

    def __init__(self, parser: AnswerParser) -> None:
        self._parser = parser

    def close(self) -> tuple[Any, ...]:
        """Return the values; raise Fault, or ValueError if it is no answer."""
        root = self._parser.root
        if root is None or root.tag != "methodResponse" or len(root) != 1:
            raise ValueError("no method response")
        if root[0].tag == "fault":
            fault = _value(_only(root[0]))
            raise xmlrpc.client.Fault(fault["faultCode"], fault["faultString"])
        return tuple(_value(_only(param)) for param in root[0])


def _only(element: Element) -> Element:
    if len(element) != 1:
        raise ValueError(f"<{element.tag}> holds {len(element)} elements")
    return element[0]


def _value(element: Element, depth: int = 0) -> Any:
    if not len(element):
        return element.text or ""
    typed = _only(element)
    if depth > DEEPEST:
        raise ValueError(f"values nested deeper than {DEEPEST}")
    if typed.tag == "array":
        return [_value(value, depth + 1) for value in _only(typed)]
    if typed.tag == "struct":
        return {_text(m.find("name")): _value(m[-1], depth + 1) for m in typed}
    if typed.tag not in _READERS:
        raise ValueError(f"<{typed.tag}> is no value of ROS")
    return _READERS[typed.tag](typed)


def _number(element: Element) -> int:
    return int(element.text or "")


def _text(element: Element | None) -> str:
    return "" if element is None else element.text or ""


_READERS: dict[str, Callable[[Element], Any]] = {
    "string": _text,
    "int": _number,
    "i4": _number,
    "i8": _number,
    "boolean": lambda element: bool(_number(element)),
    "double": lambda element: float(element.text or ""),
    "nil": lambda element: None,
}
