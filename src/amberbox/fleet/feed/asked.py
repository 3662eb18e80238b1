"""What a listener asks for."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from amberbox.core.errors import UsageError
from amberbox.fleet.feed.delta import KINDS
from amberbox.link import limits

MESSAGE_BYTES = 256 << 10
_Robot = Annotated[str, Meta(max_length=64)]
_Variable = Annotated[str, Meta(max_length=512, min_length=1)]
_Variables = Annotated[list[_Variable], Meta(max_length=limits.VARIABLES)]


class Asked(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which robots and kinds (null: all), which live values, and from which number on."""

    robots: Annotated[list[_Robot], Meta(max_length=2000)] | None = None
    kinds: Annotated[list[str], Meta(max_length=20)] | None = None
    live: Annotated[dict[_Robot, _Variables], Meta(max_length=100)] = {}
    resume: int | None = None


_DECODER = msgspec.json.Decoder(Asked)


def parsed(text: str | bytes) -> Asked:
    """Read what somebody asks for; raises UsageError."""
    if len(text) > MESSAGE_BYTES:
        raise UsageError(f"a message has at most {MESSAGE_BYTES} bytes", "ask for fewer robots")
    try:
        asked = _DECODER.decode(text)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        hint = 'send {"robots": null, "kinds": null, "live": {"ropod_001": ["odom.x"]}}'
        raise UsageError(f"this cannot be subscribed to: {error}", hint) from error
    unknown = sorted(set(asked.kinds or ()) - KINDS)
    if unknown:
        raise UsageError(f"there is no kind {unknown[0]!r}", f"kinds: {', '.join(sorted(KINDS))}")
    return asked
