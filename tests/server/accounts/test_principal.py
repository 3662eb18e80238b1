"""Who may do what: the table by hand, each role, group, scope and robot against each action."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.server.accounts.permissions import (
    ACTIONS,
    SCOPES,
    Principal,
    RobotGroups,
    Role,
    UnknownActionError,
    allowed,
)

EXPECTED = """
                    viewer operator technician admin  robot  reach   scope
    status.read     yes    yes      yes        yes    no     robot   read:status
    items.read      yes    yes      yes        yes    no     robot   read:data
    data.query      yes    yes      yes        yes    no     robot   read:data
    data.download   no     no       yes        yes    no     robot   read:download
    data.fetch      no     no       yes        yes    no     robot   write:fetch
    models.read     yes    yes      yes        yes    no     robot   read:data
    models.write    no     no       yes        yes    no     robot   write:models
    alarms.read     yes    yes      yes        yes    no     robot   read:alarms
    alarms.write    no     yes      yes        yes    no     robot   write:alarms
    incidents.read  yes    yes      yes        yes    no     robot   read:data
    incidents.write no     yes      yes        yes    no     robot   write:incidents
    missions.read   yes    yes      yes        yes    no     robot   read:data
    missions.write  no     yes      yes        yes    no     robot   write:missions
    diagnoses.read  yes    yes      yes        yes    no     robot   read:diagnoses
    diagnoses.write no     yes      yes        yes    no     robot   write:diagnoses
    commands.read   yes    yes      yes        yes    no     robot   read:commands
    commands.write  no     no       yes        yes    no     robot   write:commands
    commands.confirm no    yes      yes        yes    no     robot   write:commands
    commands.abort  no     yes      yes        yes    no     robot   write:commands
    keys.write      no     no       yes        yes    no     server  write:commands
    experiments.read  yes  yes      yes        yes    no     robot   read:experiments
    experiments.write no   no       yes        yes    no     robot   write:experiments
    experiments.upload no  no       yes        yes    no     server  write:experiments
    experiments.step  no   yes      yes        yes    no     robot   step:experiments
    demo.break      yes    yes      yes        yes    no     robot   -
    folder.read     no     no       yes        yes    no     robot   -
    robots.write    no     no       no         yes    no     server  -
    retention.write no     no       no         yes    no     server  -
    users.read      no     no       no         yes    no     server  -
    users.write     no     no       no         yes    no     server  -
    settings.write  no     no       no         yes    no     server  -
    audit.read      no     no       no         yes    no     server  read:audit
    metrics.read    no     no       yes        yes    no     server  read:metrics
    own.read        yes    yes      yes        yes    no     own     -
    own.write       yes    yes      yes        yes    no     own     -
    own.tokens      no     no       yes        yes    no     own     -
    link.connect    no     no       no         no     yes    robot   -
    journals.upload no     no       no         no     yes    robot   -
"""
ROWS = {line.split()[0]: line.split()[1:] for line in EXPECTED.splitlines()[2:] if line.strip()}
ROBOT = RobotGroups("r1", frozenset({"ward"}))
OTHER = RobotGroups("r2", frozenset({"kitchen"}))
ALL_SCOPES = frozenset(SCOPES)


def test_the_table_is_complete() -> None:
    assert set(ROWS) == set(ACTIONS)
    used = {action.scope for action in ACTIONS.values()} - {None}
    assert used == set(SCOPES)


@pytest.mark.parametrize("action", ACTIONS)
def test_each_role(action: str) -> None:
    answers = {role: answer == "yes" for role, answer in zip(Role, ROWS[action], strict=False)}
    for role, answer in answers.items():
        person = Principal("user", "anna", role, None)
        assert allowed(person, action, ROBOT) is answer
        assert allowed(person, action) is answer


@pytest.mark.parametrize("action", ACTIONS)
def test_a_person_of_another_group(action: str) -> None:
    reach = ROWS[action][5]
    for role, answer in zip(Role, ROWS[action], strict=False):
        person = Principal("user", "anna", role, frozenset({"ward"}))
        may = answer == "yes"
        assert allowed(person, action, ROBOT) is (may and reach != "server")
        assert allowed(person, action, OTHER) is (may and reach == "own")
        assert allowed(person, action, RobotGroups("r3")) is (may and reach == "own")
        assert allowed(person, action) is (may and reach == "own")
        assert allowed(replace(person, groups=frozenset()), action, ROBOT) is (
            may and reach == "own"
        )


@pytest.mark.parametrize("action", ACTIONS)
def test_a_token_needs_the_scope_and_an_owner_who_may(action: str) -> None:
    scope = ROWS[action][6]
    for role, answer in zip(Role, ROWS[action], strict=False):
        token = Principal("token", "t", role, None, ALL_SCOPES)
        assert allowed(token, action, ROBOT) is (answer == "yes" and scope != "-")
        assert not allowed(replace(token, scopes=ALL_SCOPES - {scope}), action, ROBOT)
        assert not allowed(replace(token, scopes=frozenset()), action, ROBOT)


@pytest.mark.parametrize("action", ACTIONS)
def test_a_robot_does_its_own_and_nothing_else(action: str) -> None:
    robot = Principal("robot", "r1")
    assert allowed(robot, action, ROBOT) is (ROWS[action][4] == "yes")
    assert not allowed(robot, action, OTHER)
    assert not allowed(robot, action)
    crowned = replace(robot, role=Role.ADMIN, groups=None, scopes=ALL_SCOPES)
    assert not allowed(crowned, action, OTHER)


@pytest.mark.parametrize("action", ACTIONS)
def test_who_has_to_change_the_password_does_that_first(action: str) -> None:
    person = Principal("user", "anna", Role.ADMIN, None, must_change=True)
    assert allowed(person, action, ROBOT) is (action in ("own.read", "own.write"))


@pytest.mark.parametrize("action", ACTIONS)
def test_nobody_may_do_nothing(action: str) -> None:
    assert not allowed(Principal("user", "nobody"), action, ROBOT)
    assert not allowed(Principal("token", "nothing", scopes=ALL_SCOPES), action, ROBOT)


@pytest.mark.parametrize("action", ["alarm.write", "", "STATUS.READ", "status.read "])
def test_an_unknown_action_is_a_mistake(action: str) -> None:
    for kind in ("user", "token", "robot"):
        principal = Principal(kind, "x", Role.ADMIN, None, ALL_SCOPES)
        with pytest.raises(UnknownActionError):
            allowed(principal, action, ROBOT)


def test_the_mistake_says_what_was_meant() -> None:
    with pytest.raises(UnknownActionError, match=r"did you mean 'alarms\.write'"):
        allowed(Principal("user", "anna"), "alarm.write")


GROUPS = st.one_of(st.none(), st.frozensets(st.sampled_from(["ward", "kitchen", "lab"])))
ROBOTS = st.one_of(
    st.none(),
    st.builds(RobotGroups, st.just("r1"), st.frozensets(st.sampled_from(["ward", "lab"]))),
)


@given(
    st.sampled_from(list(Role)),
    GROUPS,
    GROUPS,
    st.frozensets(st.sampled_from(sorted(SCOPES))),
    st.sampled_from(sorted(ACTIONS)),
    ROBOTS,
)
def test_less_never_allows_more(
    role: Role,
    groups: frozenset[str] | None,
    fewer: frozenset[str] | None,
    scopes: frozenset[str],
    action: str,
    robot: RobotGroups | None,
) -> None:
    person = Principal("user", "anna", role, groups)
    token = Principal("token", "t", role, groups, scopes)
    if allowed(token, action, robot):
        assert allowed(person, action, robot)
    if not allowed(person, action, robot):
        lower = [one for one in Role if role.covers(one)]
        both = groups if fewer is None else (fewer if groups is None else groups & fewer)
        assert not any(allowed(replace(person, role=one), action, robot) for one in lower)
        assert not allowed(replace(person, groups=both), action, robot)


def test_names_in_the_audit_log() -> None:
    assert str(Principal("user", "anna")) == "user:anna"
    assert str(Principal("token", "12ab", owner="anna")) == "token:12ab of anna"
