"""State bits: what the bits of a status word say, each by its name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from amberbox.core.config import Finding
from amberbox.core.mode import Input, Result, numbers, where_known
from amberbox.core.options import option
from amberbox.core.samples import Now

ACCEPTS = ("variable",)
COLUMNS = True
PER_INPUT = True
RESULTS = (
    Result("ok", "bool", "all bits are as they should be"),
    Result("word", "int", "the status word"),
)
SAMPLE = """\
name: smart_wheel_status_monitor
monitor: state_bits
description: wheels are enabled and nobody has pressed the emergency stop
mappings:
  - mapping:
      inputs: [wheels.status1]
      outputs:
        - output: {name: wheel_ok, result: ok, type: bool, expected: true}
        - output: {name: enabled, type: bool}
        - output: {name: e_stop_pressed, type: bool, severity: critical}
arguments:
  bits:
    enabled: 0
    e_stop_pressed: {bit: 2, nominal: false}
"""
_BITS = 63


@dataclass(frozen=True, slots=True)
class StateBit:
    """One bit of the word."""

    bit: int = option(doc="number of the bit; the lowest is 0")
    nominal: bool = option(True, "whether it is set when all is well")


@dataclass(frozen=True, slots=True)
class StateBitsOptions:
    """Names of the bits; a number alone is a bit that is set when all is well."""

    bits: Mapping[str, int | StateBit] = option(doc="bits by name: `enabled: 0`")

    def check(self) -> Iterator[Finding]:
        """Refuse bits that no word has, and names that are taken."""
        if not self.bits:
            yield "bits", "must name at least one bit"
        for name, bit in self.named():
            if not 0 <= bit.bit < _BITS:
                yield "bits", f"'{name}' is bit {bit.bit}; there are bits 0 to {_BITS - 1}"
            if name in {result.name for result in RESULTS}:
                yield "bits", f"no bit can have the name '{name}'"

    def named(self) -> list[tuple[str, StateBit]]:
        """Return each bit with its name."""
        found = self.bits.items()
        return [(name, StateBit(bit) if isinstance(bit, int) else bit) for name, bit in found]


Config = StateBitsOptions


def results_of(config: StateBitsOptions, inputs: int, bools: int) -> tuple[Result, ...]:
    """Return the fixed results, then one for each bit."""
    bits = config.named()
    named = (Result(n, "bool", f"bit {bit.bit} is set", nominal=bit.nominal) for n, bit in bits)
    return (*RESULTS, *named)


def evaluate(config: StateBitsOptions, inputs: Sequence[Input], now: Now) -> Mapping[str, Any]:
    """Split the last word into bits; a value that is no whole number has none."""
    (variable,) = inputs
    value = numbers(variable.at(now))
    known = variable.samples.known(now) & (np.abs(value) < 1 << 53) & (np.trunc(value) == value)
    word = np.where(known, value, 0).astype(np.int64)
    bits = {name: (word >> bit.bit) & 1 for name, bit in config.named()}
    ok = np.logical_and.reduce([bits[name] == bit.nominal for name, bit in config.named()])
    found = {name: where_known(known, value) for name, value in {"ok": ok, **bits}.items()}
    return {**found, "word": np.where(known, word, np.nan)}


def explain(config: StateBitsOptions, results: Mapping[str, Any]) -> str:
    """Name the bits that are not as they should be."""
    wrong = [name for name, bit in config.named() if results[name] is (not bit.nominal)]
    return ", ".join(f"{name} is {'set' if results[name] else 'not set'}" for name in wrong)
