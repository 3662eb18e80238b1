"""What robots know: failure modes, fault trees, rules. All is asked in a worker with limits."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from fastapi import Query
from pydantic import Field, StringConstraints

from amberbox.fleet.api.access import Caller, Fleet, OfRobot, Routes, Who
from amberbox.fleet.api.diagnoses import LIMIT_S, MEMORY_BYTES, WORKER, Hash, Moment
from amberbox.fleet.api.forms import Form
from amberbox.fleet.knowledge.asked import AboutRobot, AskRules, AskTrees, written
from amberbox.fleet.services import Services

routes = Routes("knowledge")

_AT = "as it was then; empty: now"
At = Annotated[str, Query(max_length=64, description=_AT)]
HashText = Annotated[str, Query(pattern="^([0-9a-f]{64})?$", description="a folder of the robot")]
Hours = Annotated[float | None, Query(ge=0, le=1e6, allow_inf_nan=False)]
Effect = Annotated[str, Query(max_length=200, description="a function or component; empty: all")]
Order = Annotated[int | None, Query(ge=0, le=20, description="cut sets of up to so many events")]
Count = Annotated[int, Query(ge=0, le=10_000)]


class RuleQuestion(Form):
    """A goal for the robot's rules, such as ``broken(X)``, with what they may look up."""

    query: Annotated[str, StringConstraints(min_length=1, max_length=4000)]
    from_: Moment = Field("", alias="from")
    to: Moment = ""
    want: Literal["", "why", "why_not"] = "why"
    config_hash: Hash = ""
    steps: int = Field(0, ge=0, le=50_000_000, description="stop after so many; 0: the default")


@routes.get("/robots/{robot}/fmea", "diagnoses.read")
async def read_fmea(
    robot: OfRobot, fleet: Fleet, who: Who, at: At = "", config_hash: HashText = "",
    exposure_h: Hours = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the failure modes of a robot: the sheet, what matters most, what nobody sees."""
    asked = AboutRobot(robot=robot.id, now_ns=fleet.clock.wall_ns(), at=at,
                       config_hash=config_hash, exposure_h=exposure_h)  # fmt: skip
    return await _ask(fleet, who, "fmea", asked)


@routes.get("/robots/{robot}/faulttrees", "diagnoses.read")
async def read_fault_trees(
    robot: OfRobot, fleet: Fleet, who: Who, effect: Effect = "", at: At = "",
    config_hash: HashText = "", cut_sets: Count = 100, order: Order = None,
    exposure_h: Hours = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the fault trees of all functions; of one with cut sets and what matters in it.

    ``closest`` are the cut sets that the diagnosis that stands brings closest to complete.
    """
    asked = AskTrees(
        robot=robot.id, now_ns=fleet.clock.wall_ns(), at=at, config_hash=config_hash,
        exposure_h=exposure_h, effect=effect, cut_sets=cut_sets, order=order,
    )  # fmt: skip
    return await _ask(fleet, who, "fault_trees", asked)


@routes.post("/robots/{robot}/rules", "diagnoses.write")
async def ask_rules(robot: OfRobot, body: RuleQuestion, fleet: Fleet, who: Who) -> dict[str, Any]:
    """Return all answers of a goal, each with what it follows from, or why there is none."""
    asked = AskRules(
        robot=robot.id, now_ns=fleet.clock.wall_ns(), query=body.query, from_=body.from_,
        to=body.to, want=body.want, config_hash=body.config_hash, steps=body.steps,
    )  # fmt: skip
    return await _ask(fleet, who, "rules", asked)


async def _ask(fleet: Services, who: Caller, name: str, asked: AboutRobot) -> dict[str, Any]:
    found = await fleet.asking.ask(
        f"{WORKER}:{name}", written(asked), LIMIT_S, MEMORY_BYTES, asker=who.asker
    )
    answer: dict[str, Any] = json.loads(found)
    return answer
