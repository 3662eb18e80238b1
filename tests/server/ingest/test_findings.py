"""Records are decoded strictly: an invalid one is ignored."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from amberbox.blackbox.journal import channels
from amberbox.core.types import Diagnosis
from amberbox.monitoring.findings import encoded
from amberbox.server.derived import DerivedRecord, finding
from amberbox.server.knowledge.diagnoses import findings


def said(**more: Any) -> dict[str, Any]:
    made = Diagnosis("d1", 1, "r1", 5, "hash", (), 0.9)
    values: dict[str, Any] = msgspec.json.decode(encoded(made)[1])
    return {**values, **more}


@pytest.mark.parametrize(
    "wrong",
    [{"at_ns": "now"}, {"hypotheses": 5}, {"hypotheses": ["x"]}, {"revision": None},
     {"at_ns": 2**63 - 1}, {"at_ns": 10**30}, {"revision": -(2**64)}],
)  # fmt: skip
def test_what_is_not_of_its_form_is_nothing(wrong: dict[str, Any]) -> None:
    entries = [
        DerivedRecord(channels.DIAGNOSIS, 7, 5, "s", "watch", 1, number, values)
        for number, values in enumerate((said(**wrong), said()))
    ]
    assert finding(channels.DIAGNOSIS, said(**wrong)) is None
    assert [(one.id, one.at_ns) for one in findings(entries, Diagnosis)] == [("d1", 7)]
