"""What a robot's other files say, as far as its failure modes refer to it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from amberbox.core.needs import Needs


@dataclass(frozen=True, slots=True)
class Known:
    """What there is to refer to.

    ``outputs`` are the addresses of all outputs of monitors (``component/mode/output``),
    ``watched`` those of which something is expected: only they can be symptoms. ``needs`` is what
    component files say that a component needs; it counts where the failure modes' file says
    nothing. ``addresses`` is what conditions may read besides, None if that is not known.
    ``needs`` has a key for every component of the folder; ``files`` those with monitors, and where.
    ``predicates`` are the names that a finding's goal may have, None if the rules are not known;
    ``heads`` those of rules that no other rule calls, with file and line.
    """

    outputs: Collection[str] = ()
    watched: Collection[str] = ()
    needs: Mapping[str, Needs] = field(default_factory=dict)
    addresses: Collection[str] | None = None
    predicates: Collection[tuple[str, int]] | None = None
    heads: Mapping[tuple[str, int], tuple[str, int]] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
