"""XML read safely, with the line of every element: no entities, nothing loaded from elsewhere."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from xml.parsers import expat

from amberbox.core.errors import Problem

_DEEPEST = 100


@dataclass(slots=True)
class Element:
    """An element of an XML file; ``text`` is what stands directly in it."""

    tag: str
    attributes: Mapping[str, str]
    line: int
    children: list[Element] = field(default_factory=list)
    text: str = ""
    file: str = ""

    def of_tag(self, tag: str) -> Iterator[Element]:
        """Yield the elements of a kind directly inside."""
        return (child for child in self.children if child.tag == tag)


class _RefusedError(Exception):
    """Something that is well-formed and not read all the same."""


def parse(data: bytes, file: str, problems: list[Problem]) -> Element | None:
    """Return the root element; None and a problem if the text cannot be read."""
    builder = _Builder(expat.ParserCreate(), file)
    try:
        builder.parser.Parse(data, True)
    except expat.ExpatError as error:
        what = f"is no XML: {expat.errors.messages[error.code]}"
        problems.append(Problem(file, error.lineno, "syntax", what))
    except _RefusedError as error:
        problems.append(Problem(file, builder.parser.CurrentLineNumber, "syntax", str(error)))
    except (LookupError, ValueError) as error:  # an encoding that nobody knows
        problems.append(Problem(file, 1, "syntax", str(error), "save it as UTF-8"))
    else:
        return builder.root
    return None


class _Builder:
    """Builds elements from what the parser calls."""

    def __init__(self, parser: expat.XMLParserType, file: str) -> None:
        self.parser = parser
        self.file = file
        self.root: Element | None = None
        self.open: list[Element] = []
        parser.buffer_text = True
        parser.StartElementHandler = self.start
        parser.EndElementHandler = self.end
        parser.CharacterDataHandler = self.text
        parser.EntityDeclHandler = self.refuse
        parser.SkippedEntityHandler = self.refuse

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        """Open an element."""
        if len(self.open) >= _DEEPEST:
            raise _RefusedError(f"elements are nested deeper than {_DEEPEST}")
        element = Element(tag, attributes, self.parser.CurrentLineNumber, file=self.file)
        if self.open:
            self.open[-1].children.append(element)
        else:
            self.root = element
        self.open.append(element)

    def end(self, tag: str) -> None:
        """Close an element."""
        self.open.pop()

    def text(self, text: str) -> None:
        """Add text to the element that is open."""
        self.open[-1].text += text

    def refuse(self, *what: object) -> None:
        """Refuse entities: they can grow without end and fetch files."""
        raise _RefusedError("entities are not allowed")
