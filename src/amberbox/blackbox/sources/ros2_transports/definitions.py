"""Definitions of message types that a robot names but does not send.

They come from the folders of ``definitions`` first, then from those of the ROS 2 distributions.
The type's hash, where the robot gives it, decides which of them is the robot's own.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from amberbox.blackbox.columns.ros2_types import DISTRIBUTIONS, definition_of, reads, type_hash
from amberbox.blackbox.columns.ros_definition import parse_types
from amberbox.blackbox.sources.ros2_transports.names import is_type_name
from amberbox.core.errors import AmberboxError
from amberbox.core.types import Schema

MOST_FILES = 50_000  # looked at in the folders of ``definitions``
_MOST_BYTES = 1 << 20  # of one file
_KINDS = ("msg", "srv", "action")
_PACKAGE = re.compile(rb"<name>\s*(\w+)\s*</name>")
_SEPARATOR = "=" * 80
_PARTS = re.compile(r"^---[ \t\r]*$", re.MULTILINE)
_OWN_TYPE = re.compile(r"^([ \t]*)([A-Z]\w*)(?=(\[[^]\n]*\])?[ \t])", re.MULTILINE)
# robots of distributions before Iron send no hashes; Humble is the one of them still in use
_WITHOUT_HASH, _WITH_HASH = "humble", "jazzy"


@dataclass(frozen=True, slots=True)
class FoundDefinition:
    """A schema, and where it is from; ``problem`` says why there is none, or that it may not fit.

    Without a definition the schema has no text: messages are kept as bytes.
    """

    schema: Schema
    origin: str = ""
    problem: str = ""


@dataclass
class Definitions:
    """Finds the definition of a type in folders, then in the distributions.

    ``distribution`` is that of the robot; empty if it is not known.
    """

    folders: Sequence[Path] = ()
    distribution: str = ""
    _files: Mapping[str, Path] | None = None
    _found: dict[tuple[str, str], FoundDefinition] = field(default_factory=dict)

    def find(
        self, type_name: str, wanted_hash: str = "", sample: bytes | None = None
    ) -> FoundDefinition:
        """Return the definition of a type: the one with this hash.

        Where the robot gives no hash it is the first that reads ``sample``, one message of the
        topic, to its last byte: that of ``distribution``, else of Humble, then of newer ones.
        """
        key = (type_name, wanted_hash)
        if key not in self._found:
            found = self._find(type_name, wanted_hash, sample)
            if sample is None and not wanted_hash:
                return found  # a message may decide it later
            self._found[key] = found
        return self._found[key]

    def _find(self, type_name: str, wanted_hash: str, sample: bytes | None) -> FoundDefinition:
        if not is_type_name(type_name):
            return FoundDefinition(Schema(type_name, "", b""), problem="it is no type of ROS 2")
        first: FoundDefinition | None = None
        usual = _WITH_HASH if wanted_hash else _WITHOUT_HASH
        for origin, schema in self._candidates(type_name, usual):
            found = FoundDefinition(schema, origin)
            if first is None:
                first = found
            if wanted_hash:
                own = type_hash(schema)
                if own in ("", wanted_hash):
                    return found
            elif sample is None or reads(schema, sample):
                return found
        unknown = Schema(type_name, "", b"")
        if first is None:
            what = "no definition is known; give the folder of its package under 'definitions'"
            return FoundDefinition(unknown, problem=what)
        if wanted_hash:
            what = f"the robot uses another definition of it than {first.origin} ({wanted_hash})"
            return FoundDefinition(unknown, problem=what)
        return FoundDefinition(
            first.schema, first.origin, f"a message does not fit the definition of {first.origin}"
        )

    def _candidates(self, type_name: str, usual: str) -> Iterator[tuple[str, Schema]]:
        """Yield the different definitions there are of a type, the most probable first."""
        seen = set()
        preferred = self.distribution or usual
        order = sorted(DISTRIBUTIONS, key=lambda name: name != preferred)
        for files in (self.files(), {}) if self.files() else ({},):
            for distribution in order:
                try:
                    text = _Assembly(files, distribution).text(type_name)
                except (AmberboxError, KeyError):
                    continue
                if text not in seen:
                    seen.add(text)
                    origin = f"ROS 2 {distribution.capitalize()}"
                    if _source_of(type_name) in files:
                        origin = str(files[_source_of(type_name)])
                    yield origin, Schema(type_name, "ros2msg", text.encode())

    def files(self) -> Mapping[str, Path]:
        """Return the files of definitions in the folders, by the type they define."""
        if self._files is None:
            found: dict[str, Path] = {}
            for folder in self.folders:
                for name, path in _search(folder):
                    found.setdefault(name, path)
            self._files = found
        return self._files


def _search(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield type and file of each definition: ``.../PACKAGE/msg/NAME.msg``, also of services."""
    seen = 0
    for place, folders, names in os.walk(folder):
        folders.sort()
        path = Path(place)
        seen += len(names)
        if seen > MOST_FILES:
            return
        if path.name in _KINDS:
            package = _package(path.parent)
            for name in sorted(names):
                stem, dot, suffix = name.rpartition(".")
                if dot and suffix == path.name:
                    yield f"{package}/{path.name}/{stem}", path / name


def _package(folder: Path) -> str:
    """Return the name of a package: that in its ``package.xml``, else that of its folder."""
    try:
        found = _PACKAGE.search((folder / "package.xml").read_bytes()[:_MOST_BYTES])
    except OSError:
        found = None
    return found[1].decode() if found else folder.resolve().name


@dataclass
class _Assembly:
    """Puts a definition together with those of all types in it.

    Raises KeyError when one is missing, AmberboxError when a text is no definition.
    """

    files: Mapping[str, Path]
    distribution: str

    def text(self, type_name: str) -> str:
        done: dict[str, str] = {}
        waiting = [type_name]
        while waiting:
            name = waiting.pop()
            if name not in done:
                done[name] = self._own_text(name)
                types = parse_types(Schema(name, "ros2msg", done[name].encode()))
                waiting += sorted(_named(types))
        root = done.pop(type_name)
        rest = (f"{_SEPARATOR}\nMSG: {name}\n{done[name]}\n" for name in sorted(done))
        return "".join([root.rstrip("\n") + "\n", *rest])

    def _own_text(self, type_name: str) -> str:
        """Return the definition of one type without those in it."""
        source = _source_of(type_name)
        if source in self.files:
            try:
                text = self.files[source].read_bytes()[:_MOST_BYTES].decode("utf-8", "replace")
            except OSError as error:
                raise KeyError(type_name) from error
            return _part(text, source, type_name)
        text = definition_of(self.distribution, type_name).decode()
        if not text:
            raise KeyError(type_name)
        return text.partition(_SEPARATOR)[0]


def _named(types: Mapping[str, tuple[object, Sequence[tuple[str, object]]]]) -> set[str]:
    """Return the names of the types of all fields, ``wstring`` excepted."""
    found: set[str] = set()

    def collect(desc: object) -> None:
        if isinstance(desc, tuple):
            if isinstance(desc[1], str):
                found.add(desc[1].replace("/srv/msg/", "/srv/"))
            else:
                collect(desc[1][0])

    for _, fields in types.values():
        for _, desc in fields:
            collect(desc)
    return {name for name in found if not name.endswith("/wstring")}


def _source_of(type_name: str) -> str:
    """Return the name of the file that a type is made from, as ``pkg/action/Fly``.

    The types of services and actions carry endings: ``pkg/action/Fly_FeedbackMessage``.
    """
    package, kind, name = type_name.split("/")
    return type_name if kind == "msg" else f"{package}/{kind}/{name.partition('_')[0]}"


_EVENT = """\
service_msgs/ServiceEventInfo info
{0}_Request[<=1] request
{0}_Response[<=1] response
"""
# what an action is made of beside its goal, result and feedback (design.ros2.org, actions)
_ACTION = {
    "FeedbackMessage": "unique_identifier_msgs/UUID goal_id\n{0}_Feedback feedback\n",
    "SendGoal_Request": "unique_identifier_msgs/UUID goal_id\n{0}_Goal goal\n",
    "SendGoal_Response": "bool accepted\nbuiltin_interfaces/Time stamp\n",
    "GetResult_Request": "unique_identifier_msgs/UUID goal_id\n",
    "GetResult_Response": "int8 status\n{0}_Result result\n",
}


def _part(text: str, source: str, type_name: str) -> str:
    """Return the text of one of the types that a file defines; KeyError if it has none such."""
    ending = type_name.removeprefix(source).removeprefix("_")
    kind = source.split("/")[1]
    if kind == "msg":
        return text
    if ending.endswith("Event"):
        return _EVENT.format(type_name.removesuffix("_Event"))
    if kind == "action" and ending in _ACTION:
        return _ACTION[ending].format(source)
    names = ("Request", "Response") if kind == "srv" else ("Goal", "Result", "Feedback")
    parts = _PARTS.split(text)
    if ending not in names or len(parts) != len(names):
        raise KeyError(type_name)
    package = source.partition("/")[0]  # its messages are named without it, as in a message
    return _OWN_TYPE.sub(rf"\1{package}/\2", parts[names.index(ending)].strip("\n")) + "\n"
