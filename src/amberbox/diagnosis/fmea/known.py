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
    """

    outputs: Collection[str] = ()
    watched: Collection[str] = ()
    needs: Mapping[str, Needs] = field(default_factory=dict)
    addresses: Collection[str] | None = None
