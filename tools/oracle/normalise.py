"""What cannot be frozen and is therefore replaced before two captures are compared."""

from __future__ import annotations

import re
from dataclasses import dataclass
from fnmatch import fnmatch


@dataclass(frozen=True)
class Field:
    """A piece of text that differs between two runs of one program."""

    name: str
    where: str
    """Which records it is looked for in: a pattern of their path, such as ``*doctor*``."""
    pattern: str
    to: str
    why: str


FIELDS = (
    Field("export seconds", "*", r"\b(rows|messages) in \d[\d.]* s\b", r"\1 in <seconds> s",
          "real time that an export took"),
    Field("faulttree seconds", "*faulttree*", r'"seconds": [\d.e-]+', '"seconds": <seconds>',
          "real time that solving took"),
    Field("state seconds", "*", r'"(took_s|elapsed_s|seconds)": ?\d[\d.e-]*', r'"\1": <seconds>',
          "real time that an answer took"),
    Field("durable", "*/head", r'^[0-9a-f]{8} |"durable_seq":\d+', "<durable>",
          "how much was synced when the head was written depends on the disk"),
    Field("doctor machine", "*doctor*",
          r"(?m)^(\w+ +(?:latency|write latency|disk \S+|file system|root file system|wear|memory|"
          r"python|versions?|clock|real-time clock|temperature|writing|sync\w*|boot\w*) .*)$",
          "<of this machine>", "what the doctor finds out about the disk and clock of the machine"),
    Field("signing key", "*/store/key*", r"(?m)^[A-Za-z0-9+/]{40,}=*$", "<key>",
          "each store makes a random key"),
    Field("doctor hint", "*doctor*", r"(?m)^ +hint: .*\n", "",
          "hints follow what was found on the machine"),
)  # fmt: skip
_COMPILED = [(field, re.compile(field.pattern)) for field in FIELDS]


def normalised(path: str, text: str) -> str:
    """Return a record's text with what cannot be frozen replaced."""
    for field, pattern in _COMPILED:
        if fnmatch(path, field.where):
            text = pattern.sub(field.to, text)
    return text
