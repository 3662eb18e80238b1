"""Fault trees of plants: redundant trains on shared supplies, as safety studies have them.

They are as large and as entangled as published trees of 300 to 800 gates, which cannot be shipped.
Trees in layers are those of functions that fail often: no cut set has much of the probability.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field, replace

from amberbox.diagnosis.faulttree.tree import (
    FaultTree,
    Formula,
    GateOperation,
    Name,
    all_of,
    any_of,
    at_least,
    below,
    fault_tree,
    none_of,
)


@dataclass(frozen=True, slots=True)
class PlantShape:
    """How large a plant is, and how entangled.

    Each train of a system needs up to ``supplies`` trains of systems before it; ``nots`` is the
    share of trains that count only while another event has not happened.
    """

    systems: int = 30
    trains: int = 3
    segments: int = 3
    supplies: int = 2
    sequences: int = 15
    nots: float = 0.0


@dataclass
class _Plant:
    shape: PlantShape
    rng: random.Random
    gates: dict[str, Formula] = field(default_factory=dict)
    chances: dict[str, float | None] = field(default_factory=dict)

    def event(self, name: str) -> str:
        """Return a basic event, with a probability if it is new."""
        self.chances.setdefault(name, 10 ** self.rng.uniform(-5.0, -1.5))
        return name

    def segment(self, name: str) -> str:
        """Add a pump or valve with its spare."""
        single = self.event(f"{name}_blocked")
        pair = all_of(self.event(f"{name}_a"), any_of(self.event(f"{name}_b"), "in_repair"))
        self.gates[name] = any_of(single, pair)
        return name

    def train(self, system: int, number: int) -> str:
        """Add a train: its segments in a row, and what it needs."""
        name, rng = f"s{system}t{number}", self.rng
        needs = [self.segment(f"{name}p{n}") for n in range(self.shape.segments)]
        for _ in range(rng.randint(0, self.shape.supplies) if system else 0):
            other = rng.randrange(max(0, system - 12), system)
            needs.append(f"s{other}t{number}" if rng.random() < 0.7 else f"s{other}")
        needs.append(self.event(f"room{rng.randrange(self.shape.systems // 2)}_flooded"))
        lost = any_of(*dict.fromkeys(needs))
        if rng.random() < self.shape.nots:
            lost = all_of(lost, none_of(self.event(f"bypass{rng.randrange(4)}")))
        self.gates[name] = lost
        return name

    def system(self, number: int) -> None:
        """Add a system that is lost when too many trains are, or all by a common cause."""
        trains = [self.train(number, n) for n in range(self.shape.trains)]
        needed = self.rng.choice((2, len(trains)))
        common = self.event(f"s{number}_common")
        self.gates[f"s{number}"] = any_of(at_least(needed, *trains), common, "switched_off")


def plant(shape: PlantShape, seed: int) -> FaultTree:
    """Make a plant; the same one for the same shape and seed."""
    made = _Plant(shape, random.Random(seed))
    for number in range(shape.systems):
        made.system(number)
    sequences = []
    for number in range(shape.sequences):
        lost = made.rng.sample(range(shape.systems // 3, shape.systems), made.rng.randint(2, 4))
        started = made.event(f"start{made.rng.randrange(6)}")
        made.gates[f"sequence{number}"] = all_of(started, *(f"s{n}" for n in sorted(lost)))
        sequences.append(f"sequence{number}")
    made.gates["top"] = any_of(*sequences)
    houses = {"in_repair": False, "switched_off": False}
    return _used(fault_tree("plant", "top", made.gates, made.chances, houses))


@dataclass(frozen=True, slots=True)
class LayerShape:
    """How large a tree in layers is; ``both`` is the share of ANDs, ``odd`` of NOT and XOR.

    Probabilities of events are 10 to the power of ``least`` to ``most``.
    """

    layers: int = 8
    width: int = 60
    events: int = 360
    both: float = 0.5
    odd: float = 0.0
    least: float = -2.0
    most: float = -0.6


def layers(shape: LayerShape, seed: int) -> FaultTree:
    """Make a tree whose gates use near gates of the layers below, and near events."""
    rng = random.Random(seed)
    chances = {f"e{n}": 10 ** rng.uniform(shape.least, shape.most) for n in range(shape.events)}
    events = list(chances)
    gates: dict[str, Formula] = {}
    for layer in range(shape.layers):
        for place in range(shape.width):
            inputs = [] if layer else [rng.choice(events)]
            for _ in range(rng.choice((2, 2, 3)) if layer else 0):
                below = max(0, layer - rng.choice((1, 1, 2)))
                near = min(shape.width - 1, max(0, place + rng.randint(-3, 3)))
                inputs.append(f"l{below}_{near}")
            middle = place * shape.events // shape.width
            for _ in range(rng.choice((1, 2, 3))):
                inputs.append(events[(middle + rng.randint(-12, 12)) % shape.events])
            gates[f"l{layer}_{place}"] = _gate(shape, rng, list(dict.fromkeys(inputs)), events)
    last = [f"l{shape.layers - 1}_{place}" for place in range(shape.width)]
    pairs = (all_of(*rng.sample(last, 2)) for _ in range(max(2, shape.width // 3)))
    gates["top"] = any_of(*pairs)
    return _used(fault_tree("layers", "top", gates, chances))


def _gate(shape: LayerShape, rng: random.Random, inputs: list[str], events: list[str]) -> Formula:
    kind = rng.random()
    if len(inputs) > 2 and kind < 0.15:
        made = at_least(2, *inputs)
    else:
        made = all_of(*inputs) if kind < 0.15 + shape.both else any_of(*inputs)
    if rng.random() >= shape.odd:
        return made
    other = rng.choice(events)
    return all_of(made, none_of(other)) if rng.random() < 0.6 else _exclusive(made, other)


def _exclusive(formula: Formula, event: str) -> Formula:
    return GateOperation("xor", (formula, Name(event)))


def _used(tree: FaultTree) -> FaultTree:
    """Return a tree without the gates and events that are not below its top."""
    gates, events = below(tree)
    return replace(
        tree,
        gates={name: tree.gates[name] for name in tree.gates if name in set(gates)},
        events={name: tree.events[name] for name in events},
    )
