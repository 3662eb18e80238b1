"""Components that a guard has learnt: mode files with its limits, for people to edit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence

from amberbox.agent.commissioning.draft import DraftedComponent, id_of
from amberbox.agent.commissioning.folder_files import component_file, topics_mode, yaml_text
from amberbox.agent.commissioning.rate import LearnedRate
from amberbox.core.safe_text import one_line
from amberbox.detection.limits import ItemLimits, VariableLimits

MARGIN = 0.1
_SLOW = 0.5  # of its range, that a value may change in a second for a limit to make sense
_REST_FACTOR = 2.0
_LEAST_REST_S = 1.0


def guard_files(limits: Iterable[ItemLimits], how: str) -> dict[str, str]:
    """Return the files of a component for each item, by their names in the robot folder.

    Limits are widened by 10 % of the range. ``how`` says what they were learnt from.
    """
    files: dict[str, str] = {}
    for item in limits:
        name = id_of(item.item)
        modes = dict(_modes(item))
        files |= {f"components/{name}/{mode}.yaml": text for mode, text in modes.items()}
        component = DraftedComponent(name, f"the item {item.item}", remarks=(f"learnt {how}",))
        files[f"components/{name}.yaml"] = component_file(component, list(modes))
    return files


def _modes(item: ItemLimits) -> Iterator[tuple[str, str]]:
    """Yield the mode files of an item by the names of the modes."""
    rate = LearnedRate(item.mean_hz, item.low_hz, item.longest_gap_s)
    yield "topics", topics_mode({item.item: rate}, f"the item {item.item}")
    for variable in item.variables:
        if _has_range(variable):
            yield f"range_{id_of(variable.name)}", _range(item, variable)
        if _changes_slowly(variable):
            yield f"change_{id_of(variable.name)}", _change(item, variable)
    resting = [v for v in item.variables if v.rest_s is not None]
    if resting:
        yield "frozen", _frozen(item, resting)
    if item.variables:
        yield "garbage", _garbage(item)


def _has_range(variable: VariableLimits) -> bool:
    return variable.high > variable.low and not variable.counter


def _changes_slowly(variable: VariableLimits) -> bool:
    change = variable.change_per_s
    return _has_range(variable) and change is not None and 0 < change < _SLOW * variable.width


def _mode(
    item: ItemLimits,
    names: tuple[str, str],
    description: str,
    variables: Iterable[VariableLimits],
    output: str,
    arguments: Sequence[str],
) -> str:
    """Return a mode file with one output for all of its inputs."""
    name, monitor = names
    inputs = "".join(
        f"        - {yaml_text(f'{item.item}.{variable.name}')}\n" for variable in variables
    )
    lines = "".join(f"  {line}\n" for line in arguments)
    return f"""\
name: {name}
monitor: {monitor}
description: {yaml_text(one_line(description))}
mappings:
  - mapping:
      inputs:
{inputs}      outputs:
        - output: {{name: {output}, type: bool, severity: warning, heal: 2 s}}
arguments:
{lines}"""


def _range(item: ItemLimits, variable: VariableLimits) -> str:
    margin = MARGIN * variable.width
    low, high = (
        _rounded(variable.low - margin, math.floor),
        _rounded(variable.high + margin, math.ceil),
    )
    return _mode(
        item,
        (f"range_{id_of(variable.name)}", "range"),
        f"{item.item}.{variable.name} is within the limits that were learnt",
        [variable],
        "in_range",
        [
            f"min: {low}    # {variable.low:.6g} was the least",
            f"max: {high}    # {variable.high:.6g} was the greatest",
        ],
    )


def _change(item: ItemLimits, variable: VariableLimits) -> str:
    assert variable.change_per_s is not None
    most = variable.change_per_s + MARGIN * variable.width
    limit = _rounded(most, math.ceil)
    return _mode(
        item,
        (f"change_{id_of(variable.name)}", "rate_of_change"),
        f"{item.item}.{variable.name} does not change faster than was learnt",
        [variable],
        "in_limits",
        [
            f"min: -{limit}    # a second; {variable.change_per_s:.6g} was the greatest change",
            f"max: {limit}",
            f"window: {max(1, math.ceil(2 / item.mean_hz))} s",
        ],
    )


def _frozen(item: ItemLimits, resting: Sequence[VariableLimits]) -> str:
    longest_s = max(variable.rest_s or 0.0 for variable in resting)
    window_s = max(_REST_FACTOR * longest_s, _LEAST_REST_S, 4 / item.mean_hz)
    return _mode(
        item,
        ("frozen", "frozen"),
        f"values of {item.item} change as they did",
        resting,
        "moving",
        [f"window: {window_s:.2g} s    # the longest rest was {longest_s:.3g} s"],
    )


def _garbage(item: ItemLimits) -> str:
    share = max(variable.garbage for variable in item.variables)
    window_s = max(item.window_s, 5.0)
    return _mode(
        item,
        ("garbage", "garbage"),
        f"values of {item.item} are numbers",
        item.variables,
        "clean",
        [
            f"window: {window_s:.3g} s",
            f"tolerated: {min(100 * (2 * share + 0.01 * (share > 0)), 100):.3g} %"
            f"    # {share:.2%} were not finite",
        ],
    )


def _rounded(value: float, towards: Callable[[float], int]) -> str:
    """Return a number with three digits that count, rounded to the outside."""
    if value == 0:
        return "0"
    step = 10.0 ** (math.floor(math.log10(abs(value))) - 2)
    return f"{towards(value / step) * step:.6g}"
