"""Which topics of a bus are recorded, and with which options: by name, by pattern, by type.

In a pattern ``*`` stands for any characters within one level of a name, ``**`` for whole levels:
``/cam/*`` are the topics right below ``/cam``, ``/cam/**`` all below it, ``/**/image`` those
called so at any level. Patterns of types are the same: ``sensor_msgs/*``. A topic that is listed by
its name is recorded in any case; exclusions and types choose among those that patterns find.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

from amberbox.core.errors import did_you_mean
from amberbox.core.options import option
from amberbox.core.source import TopicOptions

MOST_CHARACTERS = 1024  # a longer name is never found by a pattern
_MOST_REMEMBERED = 8192  # topics whose choice is remembered
_ANY_TYPE = ("", "*")  # what a bus tells where it does not know the type


def is_pattern(name: str) -> bool:
    """Return whether a name stands for several topics."""
    return "*" in name


def pattern_problem(text: str) -> str:
    """Return what is wrong with a pattern; empty if nothing is."""
    if any("**" in level and level != "**" for level in text.split("/")):
        return f"'{text}': ** stands for whole levels, as in /cam/**/image"
    return ""


def unknown_topics(
    topics: Iterable[TopicOptions], known: Collection[str]
) -> Iterator[tuple[str, str]]:
    """Yield key and problem of each topic that a source with a fixed list of topics has not."""
    for topic in topics:
        if topic.name not in known:
            near = did_you_mean(topic.name, known)
            yield (
                "topics",
                f"there is no topic '{topic.name}'{near or '; there are ' + ', '.join(known)}",
            )


class TopicPattern:
    """One pattern of names; compiled once, matched in linear time whatever a name holds."""

    def __init__(self, text: str) -> None:
        self.text = text
        levels = text.split("/")
        if levels[-1] == "**":  # all below: one level at least
            levels.append("*")
        # None stands for any number of levels
        self._levels = [None if level == "**" else _compiled(level) for level in levels]

    def fits(self, name: str) -> bool:
        """Return whether a name is one of those the pattern stands for."""
        levels, names = self._levels, name.split("/")
        level = place = 0
        restart: tuple[int, int] | None = None
        while place < len(names):
            wanted = levels[level] if level < len(levels) else None
            if level < len(levels) and wanted is None:
                level += 1
                restart = level, place
            elif wanted is not None and wanted.fullmatch(names[place]):
                level, place = level + 1, place + 1
            elif restart is not None:  # let the last ** stand for one level more
                level, place = restart[0], restart[1] + 1
                restart = level, place
            else:
                return False
        return all(wanted is None for wanted in levels[level:])

    def covers(self, text: str) -> bool:
        """Return whether each name that another pattern stands for fits this one, too."""
        return all(self.fits(text.replace("**", "/".join("*" * deep))) for deep in (1, 2, 9))


def _compiled(level: str) -> re.Pattern[str]:
    """Compile one level; atomic groups keep the time linear."""
    first, *others = map(re.escape, level.split("*"))
    if not others:
        return re.compile(first)
    middle = "".join(f"(?>.*?{piece})" for piece in others[:-1])
    return re.compile(f"{first}{middle}.*{others[-1]}", re.DOTALL)


class TopicSelection:
    """Chooses among the topics that a source finds, and gives each its options.

    ``topics`` are those of ``black_box.yaml``, their names completed; ``left_out`` are patterns of
    what ``all_topics`` does not mean. Each topic is matched once, then remembered.
    """

    def __init__(
        self,
        topics: Iterable[TopicOptions],
        *,
        all_topics: bool = False,
        exclude: Iterable[str] = (),
        types: Iterable[str] = (),
        exclude_types: Iterable[str] = (),
        left_out: Iterable[str] = (),
    ) -> None:
        listed = list(topics)
        self.named = {topic.name: topic for topic in listed if not is_pattern(topic.name)}
        self.patterns = [
            (TopicPattern(topic.name), topic) for topic in listed if is_pattern(topic.name)
        ]
        self._all = all_topics
        self._exclude = [TopicPattern(text) for text in exclude]
        self._types = [TopicPattern(short_type(text)) for text in types]
        self._exclude_types = [TopicPattern(short_type(text)) for text in exclude_types]
        self._left_out = [TopicPattern(text) for text in left_out]
        self._choice = lru_cache(_MOST_REMEMBERED)(self._is_chosen)

    @property
    def finds_topics(self) -> bool:
        """Return whether topics may be recorded that are not listed by name."""
        return self._all or bool(self.patterns)

    @property
    def needs_types(self) -> bool:
        """Return whether the type of a topic decides; while it is unknown, it is not chosen."""
        return self.finds_topics and bool(self._types or self._exclude_types)

    def chooses(self, name: str, type_name: str = "") -> bool:
        """Return whether a topic is recorded."""
        return name in self.named or self._choice(name, type_name)

    def excludes(self, name: str) -> bool:
        """Return whether an exclusion names a topic."""
        return len(name) > MOST_CHARACTERS or any(one.fits(name) for one in self._exclude)

    def options(self, name: str) -> TopicOptions | None:
        """Return the options of a topic: those given with its name, else with the first pattern."""
        if name in self.named or len(name) > MOST_CHARACTERS:
            return self.named.get(name)
        found = (topic for pattern, topic in self.patterns if pattern.fits(name))
        topic = next(found, None)
        return None if topic is None else replace(topic, name=name)

    def _is_chosen(self, name: str, type_name: str) -> bool:
        if self.excludes(name):
            return False
        is_found = any(pattern.fits(name) for pattern, _ in self.patterns)
        if not is_found and (not self._all or any(one.fits(name) for one in self._left_out)):
            return False
        return not self.needs_types or self._has_type(type_name)

    def _has_type(self, type_name: str) -> bool:
        if type_name in _ANY_TYPE or len(type_name) > MOST_CHARACTERS:
            return False
        short = short_type(type_name)
        if any(one.fits(short) for one in self._exclude_types):
            return False
        return not self._types or any(one.fits(short) for one in self._types)


def short_type(name: str) -> str:
    """Return a type without ``/msg/``, as ROS 1 writes it: ``sensor_msgs/Image``."""
    return name.replace("/msg/", "/")


@dataclass(frozen=True)
class SelectionOptions:
    """The keys by which a block chooses topics; sources whose bus lists its topics add theirs."""

    # what ``all_topics`` does not mean
    left_out: ClassVar[Sequence[str]] = ("/rosout", "/rosout_agg")

    topics: Sequence[TopicOptions] = option(
        (), "topics to record, of any type; with * or ** in its name, all that match"
    )
    all_topics: bool = option(False, "record every topic there is, /rosout excepted")
    namespace: str = option("", "completes names without leading slash, also in 'exclude'")
    exclude: Sequence[str] = option((), "names and patterns of topics that are not to be found")
    types: Sequence[str] = option((), "types and patterns of types; found are only topics of these")
    exclude_types: Sequence[str] = option((), "types and patterns of types that are not found")

    @staticmethod
    def is_name(name: str) -> bool:
        """Return whether the bus allows a name; sources define their own."""
        return bool(name)

    def full_name(self, name: str) -> str:
        """Return a name with its namespace: ``odom`` becomes ``/odom`` or ``/robot1/odom``."""
        whole = name if name.startswith("/") else f"{self.namespace}/{name}"
        return "/" + "/".join(part for part in whole.split("/") if part)

    def full_topics(self) -> list[TopicOptions]:
        """Return the options of the topics, their names completed."""
        return [replace(topic, name=self.full_name(topic.name)) for topic in self.topics]

    def announced_topics(self) -> list[TopicOptions]:
        """Return what ``Source.topics`` gives: everything is a pattern beside listed topics."""
        everything = [TopicOptions("/**")] if self.topics and self.all_topics else []
        return [*self.full_topics(), *everything]

    def selection(self) -> TopicSelection:
        """Return what chooses among the topics that are found."""
        return TopicSelection(
            self.full_topics(),
            all_topics=self.all_topics,
            exclude=map(self.full_name, self.exclude),
            types=self.types,
            exclude_types=self.exclude_types,
            left_out=self.left_out,
        )

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why."""
        if not self.topics and not self.all_topics:
            yield "topics", "names no topic; list them, or write 'all_topics: true'"
        if self.namespace and not self.is_name(self.full_name("/" + self.namespace)):
            yield "namespace", f"'{self.namespace}' is not a name ROS allows"
        seen: dict[str, str] = {}
        for name in (topic.name for topic in self.topics):
            whole = self.full_name(name)
            yield from (("topics", what) for what in self._wrong_with(name))
            if seen.setdefault(whole, name) != name:
                yield "topics", f"'{seen[whole]}' and '{name}' are the same topic"
        for name in self.exclude:
            yield from (("exclude", what) for what in self._wrong_with(name))
            if not is_pattern(name) and self.full_name(name) in seen:
                yield "exclude", f"'{name}' is also listed under 'topics'; remove one of them"
        for key in ("types", "exclude_types"):
            yield from ((key, what) for what in wrong_types(getattr(self, key)))

    def _wrong_with(self, name: str) -> Iterator[str]:
        whole = self.full_name(name)
        wrong = pattern_problem(whole)
        if wrong:
            yield wrong
        elif not self.is_name(re.sub(r"\*+", "a", whole)):
            yield f"'{name}' is not a name ROS allows for a topic"

    def notes(self) -> Iterator[tuple[str, str]]:
        """Yield what can have no effect."""
        patterns = [topic.name for topic in self.full_topics() if is_pattern(topic.name)]
        for number, text in enumerate(patterns):
            for name in map(self.full_name, self.exclude):
                if TopicPattern(name).covers(text):
                    yield "topics", f"'{text}' finds nothing: '{name}' excludes all of it"
            for earlier in patterns[:number]:
                if TopicPattern(earlier).covers(text):
                    what = f"'{text}' is not used: '{earlier}' before it matches the same topics"
                    yield "topics", what
        if not patterns and not self.all_topics:
            for key in ("exclude", "types", "exclude_types"):
                if getattr(self, key):
                    yield key, "has no effect: every topic is listed by its name"


def wrong_types(types: Sequence[str]) -> Iterator[str]:
    """Yield what is wrong with patterns of types."""
    for name in types:
        if pattern_problem(name):
            yield pattern_problem(name)
        elif "/" not in name and name != "**":
            yield f"'{name}' is no type; write PACKAGE/{name}, or '*/{name}' for any package"
