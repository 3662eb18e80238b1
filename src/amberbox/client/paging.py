"""Lists that come in pages, as one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import msgspec

from amberbox.client.wire import Query, Wire

PAGE = 1000
One = TypeVar("One")


def paged(
    wire: Wire, path: str, kind: type[One], last: Callable[[One], Any], query: Query | None = None,
    page: int = PAGE,
) -> Iterator[One]:  # fmt: skip
    """Yield all entries of a list; ``last`` names the one behind which the next page begins."""
    after: Any = ""
    while True:
        asked = {**(query or {}), "limit": page, "after": after}
        said = msgspec.json.decode(wire.get(path, asked).body)
        found = [msgspec.convert(one, kind) for one in said]
        yield from found
        if len(found) < page:
            return
        after = last(found[-1])
