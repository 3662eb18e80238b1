"""What models add to the FMEA: which missions are drawn, and which tables are made of them."""

from __future__ import annotations

import pytest

from amberbox.diagnosis.covering.model import UNKNOWN
from amberbox.diagnosis.models import ModelKind
from benchmarks.accuracy import Outcome
from benchmarks.providers import (
    CHOICES,
    MARKS,
    READ_BY,
    READ_MARKS,
    read,
    read_by,
    tables,
)


@pytest.mark.parametrize("kind", READ_BY)
def test_a_disturbance_is_of_what_models_of_the_kind_read(kind: ModelKind) -> None:
    columns = read_by(kind)
    missions = [read(kind, seed) for seed in range(8)]
    for mission in missions:
        (disturbance,) = mission.disturbances
        assert not mission.faults
        variable = disturbance.variable.replace(".", "_")
        item = f"sim_{disturbance.item}"
        assert item in columns and (not variable or variable in columns[item])
    assert missions == [read(kind, seed) for seed in range(8)]
    assert len({mission.disturbances[0].item for mission in missions}) > 1


def outcomes(kind: str, *groups: list[list[str]]) -> list[Outcome]:
    """Return outcomes of one mission, by choice of evidence."""
    return [
        Outcome(kind, 7, [], [UNKNOWN], group=group, probability=0.9, evidence=name)
        for name, group in zip(CHOICES, groups, strict=True)
    ]


def test_each_table_has_its_kinds_of_missions() -> None:
    said, wrong = [[UNKNOWN]], [["imu#gyro_bias"]]
    found = outcomes("equations", wrong, said, wrong, said)
    ((figures, marks),) = tables(found, "x")
    assert marks == READ_MARKS
    assert "said not to be in the FMEA | 0 of 1 | 1 of 1 | 0 of 1 | 1 of 1 |" in figures
    assert "wrong mode, above 80 % | 1 of 1 | 0 of 1 | 1 of 1 | 0 of 1 |" in figures
    both = list(tables([*found, *outcomes("drawn", said, said, said, said)], "x"))
    assert [marks for _, marks in both] == [MARKS, READ_MARKS]
    assert "1 drawn." in both[0][0] and "1 equations." in both[1][0]
