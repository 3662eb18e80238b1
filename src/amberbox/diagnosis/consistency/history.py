"""What is known of a model over time, and the questions about it: when, how probable, what next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod

from amberbox.core.contracts import Budget
from amberbox.core.errors import UsageError
from amberbox.diagnosis.consistency.components import Components, Step
from amberbox.diagnosis.consistency.encoding import Start, State, starts_of
from amberbox.diagnosis.consistency.engines import SolverName
from amberbox.diagnosis.consistency.question import Question, of_components
from amberbox.diagnosis.consistency.recovery import Goal, Recovery, find_plan
from amberbox.diagnosis.consistency.tracking import Tracker
from amberbox.diagnosis.consistency.trajectories import NOTHING_SEEN, Moves, Times, times_of

_MOST_ENDS = 200  # states that a plan is made for


@dataclass(frozen=True)
class History:
    """The steps that are looked at, and what is remembered of those before them."""

    model: Components
    steps: Sequence[Step]
    starts: Sequence[Start]
    before: Step = NOTHING_SEEN
    forgotten: int = 0
    pruned: float = 0.0
    is_cut: bool = False
    """Whether ``pruned`` may be more."""

    @classmethod
    def of(cls, model: Components, steps: Sequence[Step], budget: Budget) -> History:
        """Return the history after some steps: all of them, or the last ones of a long sequence.

        Raises OutOfTimeError.
        """
        if not model.is_timed or not model.history or len(steps) <= 2 * model.history:
            return cls(model, steps, starts_of(model))
        tracker = Tracker(model, budget)
        for step in steps:
            tracker.take(step)
        return cls(
            model, tracker.steps, tracker.starts, tracker.before, tracker.forgotten,
            tracker.pruned, tracker.is_cut,
        )  # fmt: skip

    def question(self, budget: Budget, solver_name: SolverName = "") -> Question:
        """Return the question which faults components have."""
        return of_components(
            self.model, self.steps, budget, self.starts,
            seen=self.before.observe, solver_name=solver_name,
        )  # fmt: skip

    def times(self, moves: Moves, names: Sequence[str], rank: int) -> Times:
        """Return when the faults of a diagnosis may have happened; raises OutOfTimeError."""
        return times_of(
            self.model, moves, self.starts, self.steps, names, rank, self.before, self.forgotten
        )

    def probabilities(
        self, diagnoses: Sequence[tuple[int, Sequence[str]]], times: Sequence[Times] = ()
    ) -> list[float]:
        """Return the share of each diagnosis in their probability.

        It is the product of the probabilities of its faults, for each way over time if those are
        given; sound components count as certain.
        """
        weights = [
            prod(self.model.mode(name).probability or 0.001 for name in names)
            for _, names in diagnoses
        ]
        if times:
            weights = [w * of.variants for w, of in zip(weights, times, strict=True)]
        total = sum(weights)
        return [weight / total if total else 0.0 for weight in weights]

    def plan(self, times: Sequence[Times], goal: Goal, budget: Budget) -> Recovery:
        """Return the commands that reach a goal for certain, whichever of the diagnoses is right.

        Raises OutOfTimeError, and UsageError if there are too many states to plan for.
        """
        states: list[State] = list(dict.fromkeys(state for of in times for state in of.states))
        if len(states) > _MOST_ENDS:
            raise UsageError(
                f"the components may be in {len(states):,} states: more than {_MOST_ENDS} are not "
                "planned for",
                "more observations leave fewer; without --safe only the likeliest diagnosis counts",
            )
        last = self.steps[-1] if self.steps else self.before
        return find_plan(self.model, sorted(states), last, goal, budget)
