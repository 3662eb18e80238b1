"""docs/server/security.md matches the code: the table, the limits, the times."""

from __future__ import annotations

import re
from pathlib import Path

from amberbox.core.clock import NS
from amberbox.server.accounts import sessions, signin, tokens
from amberbox.server.accounts.passwords import LONGEST, SHORTEST, HashCost
from amberbox.server.accounts.permissions import ACTIONS, SCOPES, Action
from amberbox.server.accounts.robots import OVERLAP_NS
from amberbox.server.accounts.signin import LIMITS

PAGE = (Path(__file__).parents[3] / "docs" / "server" / "security.md").read_text(encoding="utf-8")
DAY_NS = 24 * 3600 * NS


def _row(name: str, action: Action) -> str:
    role = "robot only" if action.role is None else str(action.role)
    scope = "never" if action.scope is None else f"`{action.scope}`"
    return f"| `{name}` | {role} | {scope} | {action.reach} |"


def test_the_table_of_actions_is_the_code() -> None:
    listed = re.findall(r"^\| `[a-z]+\.[a-z]+` \|.*$", PAGE, re.MULTILINE)
    assert listed == [_row(name, action) for name, action in ACTIONS.items()]
    assert all(f"`{scope}`" in PAGE for scope in SCOPES)


def test_the_limits_of_wrong_logins_are_the_code() -> None:
    rows = re.findall(r"^\| (?:account|address)[^|]*\| (\d+) \|[^|]*\| (\d+) (min|s)", PAGE, re.M)
    units = {"min": 60 * NS, "s": NS}
    told = [(int(free), int(most) * units[unit]) for free, most, unit in rows]
    assert told == [(limit.free, limit.longest_ns) for limit in LIMITS.values()]


def test_the_times_and_sizes_are_the_code() -> None:
    cost = HashCost()
    minutes, hours = sessions.IDLE_NS // (60 * NS), sessions.LONGEST_NS // (3600 * NS)
    for sentence in (
        f"{cost.passes} passes over {cost.memory_kib // 1024} MB",
        f"{minutes} minutes without a request, {hours} hours after the login",
        f"{SHORTEST} to {LONGEST} characters",
        f"at most {tokens.LONGEST_NS // DAY_NS}",
        f"an overlap ({OVERLAP_NS // DAY_NS} days)",
        f"for {signin.SETUP_LASTS_NS // (60 * NS)} minutes, once",
    ):
        assert sentence in PAGE
