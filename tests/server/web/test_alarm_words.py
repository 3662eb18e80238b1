"""What parts of robots are called in lists of alarms: looked up, not searched for."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from amberbox.server.live.facts import ComponentFacts, FolderFacts
from amberbox.server.services.context import Services
from amberbox.server.web.alarms import AlarmTexts


class Counted(list[ComponentFacts]):
    """Components of a folder that count how often they are iterated."""

    looked = 0

    def __iter__(self) -> Any:
        self.looked += 1
        return super().__iter__()


def words_over(components: list[ComponentFacts]) -> AlarmTexts:
    facts = FolderFacts(components=components)
    book = SimpleNamespace(known=lambda robot, _: facts if robot == "r1" else None)
    state = SimpleNamespace(cards=SimpleNamespace(facts=book))
    return AlarmTexts(cast("Services", SimpleNamespace(feed=SimpleNamespace(state=state))))


def test_parts_are_looked_through_once_for_all_alarms_of_a_robot() -> None:
    parts = Counted(ComponentFacts(f"part_{n}", f"the part {n}") for n in range(500))
    words = words_over(parts)
    assert [words.part("r1", f"part_{n}") for n in range(500)] == [
        f"The part {n}" for n in range(500)
    ]
    assert parts.looked == 1


def test_a_part_without_a_name_of_its_own_is_called_by_its_id() -> None:
    words = words_over([ComponentFacts("laser_front", "laser_front"), ComponentFacts("imu")])
    assert words.part("r1", "laser_front") == "Laser front"
    assert words.part("r1", "imu") == words.part("r2", "imu") == "Imu"
