"""A reader made for one message type: it finds where every field of a message lies.

The source text is generated from numbers only (sizes, slots), never from names in a definition.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from struct import Struct, error
from typing import Any, TypeAlias

from amberbox.blackbox.unroll.definition import SIZES
from amberbox.blackbox.unroll.wire import (
    ChildrenOp,
    FixedOp,
    Lead,
    NumbersOp,
    Op,
    Plan,
    TextOp,
    TextsOp,
    WireTable,
)

Slots: TypeAlias = list[list[int]]
Walk: TypeAlias = Callable[[bytes, int, int], None]
Walker: TypeAlias = Callable[..., Walk]

MISFITS = (ValueError, IndexError, error)
"""What a walk raises on a message that does not fit."""

_MOST_EMPTY_ROWS = 1 << 8
"""Structures without a single byte can come in any claimed number; this many are believed."""
MOST_ROWS = 1 << 21
"""Rows of child tables that one message may have together; one with more has no columns."""


def compile_walker(plan: Plan, watch: bool = False) -> Walker:
    """Compile ``make(big_endian, slots, checks) -> walk(data, start, end)``.

    A walk appends the places of one message to the slots. It raises one of ``MISFITS`` if the
    message is shorter or longer than its definition says. With ``watch`` it also appends to
    ``checks`` the place and length of everything that other fields' places depend on.
    """
    lines = list(_Source(plan, watch).lines())
    space: dict[str, Any] = {"word": {False: _word("<"), True: _word(">")}}
    exec("\n".join(lines), space)
    made: Walker = space["make"]
    return made


def _word(order: str) -> Callable[[bytes, int], tuple[Any, ...]]:
    return Struct(f"{order}I").unpack_from


class _Source:
    def __init__(self, plan: Plan, watch: bool) -> None:
        self.plan = plan
        self.watch = watch

    def lines(self) -> Iterator[str]:
        yield "def make(big_endian, slots, checks):"
        yield " u = word[big_endian]"
        yield " c = checks.append"
        for slot in range(self.plan.slots):
            yield f" s{slot} = slots[{slot}].append"
        yield " def walk(d, p, e):"
        if self.plan.cdr:
            yield "  p += 4"
        yield "  o = p"
        yield "  r = 0"
        yield from _indented(self.table(self.plan.table), 2)
        trailing = 3 if self.plan.cdr else 0  # CDR writers pad messages to 4 bytes
        yield f"  if not 0 <= e - p <= {trailing}: raise ValueError"
        yield " return walk"

    def table(self, table: WireTable) -> Iterator[str]:
        for op in table.ops:
            yield from self.op(op)

    def op(self, op: Op) -> Iterator[str]:
        match op:
            case FixedOp():
                yield from _lead(op.lead)
                yield f"s{op.slot}(p)"
                yield f"p += {op.size}"
            case TextOp():
                yield from _lead(op.lead)
                yield from self.text(op.slot, op.slot + 1, op.wide)
            case NumbersOp():
                yield from self.numbers(op)
            case TextsOp():
                yield from self.texts(op)
            case ChildrenOp():
                yield from self.children(op)

    def prefix(self) -> Iterator[str]:
        if self.watch:
            yield "c((p, 4))"
        yield "n = u(d, p)[0]"
        yield "p += 4"

    def text(self, start: int, end: int, wide: bool) -> Iterator[str]:
        yield from self.prefix()
        yield f"s{start}(p)"
        if wide:
            yield "p += 4 * n"
            yield f"s{end}(p)"
        elif not self.plan.cdr:
            yield "p += n"
            yield f"s{end}(p)"
        else:
            yield from self.terminated(end)

    def terminated(self, end: int) -> Iterator[str]:
        """Read a CDR string: its length counts the NUL; some writers send an empty one as 0."""
        yield "if n:"
        yield " p += n"
        if self.watch:
            yield " c((p - 1, 1))"
        yield " if d[p - 1]: raise ValueError"
        yield f" s{end}(p - 1)"
        yield "else:"
        yield f" s{end}(p)"

    def numbers(self, op: NumbersOp) -> Iterator[str]:
        yield from _lead(op.lead)
        if op.count is None:
            yield from self.prefix()
            if op.align > 4:
                yield f"if n: p += (o - p) & {op.align - 1}"  # an empty sequence has no gap
        else:
            yield f"n = {op.count}"
        yield f"s{op.slot}(p)"
        yield f"s{op.slot + 1}(n)"
        yield f"p += {SIZES[op.item]} * n"

    def count(self, op: TextsOp | ChildrenOp, smallest: int) -> Iterator[str]:
        if op.count is None:
            yield from _lead(op.lead)
            yield from self.prefix()
        else:
            yield f"n = {op.count}"
        limit = f"{smallest} * n > e - p" if smallest else f"n > {_MOST_EMPTY_ROWS}"
        yield "r += n"
        yield f"if {limit} or r > {MOST_ROWS}: raise ValueError"
        yield f"s{op.slot}(n)"

    def texts(self, op: TextsOp) -> Iterator[str]:
        yield from self.count(op, 4)
        yield "for _ in range(n):"
        if self.plan.cdr:
            yield " p += (o - p) & 3"
        yield from _indented(self.text(op.slot + 1, op.slot + 2, op.wide), 1)

    def children(self, op: ChildrenOp) -> Iterator[str]:
        yield from self.count(op, op.table.smallest)
        if op.stride is None:
            yield "for _ in range(n):"
            yield from _indented(self.table(op.table), 1)
            yield " pass"
            return
        if op.align > 1:
            yield f"if n: p += (o - p) & {op.align - 1}"
        yield f"s{op.slot + 1}(p)"
        yield f"p += {op.stride} * n"


def _lead(lead: Lead) -> Iterator[str]:
    if lead.align > 1:
        yield f"p += (o - p) & {lead.align - 1}"
    elif lead.skip:
        yield f"p += {lead.skip}"


def _indented(lines: Iterator[str], depth: int) -> Iterator[str]:
    return (" " * depth + line for line in lines)


def walk_all(
    walker: Walker, plan: Plan, data: bytes, sizes: Sequence[int], big_endian: bool
) -> tuple[Slots, list[int]]:
    """Walk all messages of a joined buffer; return the slots and the places of misfits."""
    slots: Slots = [[] for _ in range(plan.slots)]
    walk = walker(big_endian, slots, [])
    bad, start = [], 0
    for index, size in enumerate(sizes):
        try:
            walk(data, start, start + size)
        except MISFITS:
            bad.append(index)
        start += size
    return slots, bad
