"""Probes run on time in threads of their own; those that hang or crash do not affect others."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from amberbox.core.probe import ProbeOrder
from amberbox.monitoring.probe_runner import ProbeRunner, Row, next_due_s
from amberbox.testing.clock import PATIENCE_S

COUNTING = """\
import itertools
MEASURES = {"n": ("int", "", "how often it looked"), "share": ("float", "", "a number")}
SUBJECT = "anything"
PERIOD_S = 0.05
looks = itertools.count()
def measure(subject):
    return {"ok": True, "n": next(looks), "share": 1}
"""

HANGING = """\
import time
from pathlib import Path
MEASURES = {"n": ("int", "", "a number")}
SUBJECT = "a file: hangs until it is there"
PERIOD_S = 0.05
TIMEOUT_S = 0.15
def measure(subject):
    with open(subject + ".looks", "a") as looks:
        looks.write("x")
    while not Path(subject).exists():
        time.sleep(0.005)
    return {"ok": True, "n": 1}
"""

FAILING = """\
MEASURES = {"n": ("int", "", "a number")}
SUBJECT = "how to fail"
PERIOD_S = 0.05
def measure(subject):
    if subject == "system":
        open("/there/is/no/such/file")
    if subject == "more":
        return {"ok": True, "m": 1}
    if subject == "type":
        return {"ok": True, "n": "seven"}
    if subject == "nothing":
        return {}
    raise ZeroDivisionError("one by zero")
"""


class Rows:
    """Collects rows from all threads, and waits for them."""

    def __init__(self) -> None:
        self.all: list[tuple[float, ProbeOrder, Row]] = []
        self._changed = threading.Condition()

    def put(self, order: ProbeOrder, row: Row) -> None:
        with self._changed:
            self.all.append((time.monotonic(), order, row))
            self._changed.notify_all()

    def wait(self, condition: Callable[[], object]) -> None:
        with self._changed:
            assert self._changed.wait_for(condition, PATIENCE_S), self.all

    def of(self, kind: str) -> list[Row]:
        return [row for _, order, row in self.all if order.kind == kind]


@pytest.fixture
def probes(tmp_path: Path) -> Path:
    folder = tmp_path / "probes"
    folder.mkdir()
    for name, text in (("counting", COUNTING), ("hanging", HANGING), ("failing", FAILING)):
        (folder / f"{name}.py").write_text(text)
    return folder


def test_every_probe_looks_at_once_and_then_by_its_period(probes: Path) -> None:
    rows = Rows()
    runner = ProbeRunner([ProbeOrder("counting", "a")], rows.put, [probes])
    start_s = time.monotonic()
    runner.start()
    rows.wait(lambda: len(rows.all) >= 8)
    runner.close()
    assert [row["n"] for row in rows.of("counting")][:8] == list(range(8))
    assert rows.all[0][2] == {"subject": "a", "ok": True, "error": "", "n": 0, "share": 1.0}
    assert type(rows.all[0][2]["share"]) is float
    for number, (at_s, _, _) in enumerate(rows.all[:8]):
        assert at_s - start_s >= number * 0.05


@pytest.mark.parametrize(
    ("now_s", "due_s"), [(100.0, 101.0), (100.4, 101.0), (101.0, 102.0), (104.9, 105.0)]
)
def test_the_schedule_does_not_drift_and_makes_up_for_nothing(now_s: float, due_s: float) -> None:
    assert next_due_s(100.0, 1.0, now_s) == due_s


def test_a_probe_that_hangs_says_so_at_its_period_and_disturbs_nobody(
    probes: Path, tmp_path: Path
) -> None:
    rows, file = Rows(), tmp_path / "there"
    orders = [ProbeOrder("hanging", str(file)), ProbeOrder("counting", "a")]
    runner = ProbeRunner(orders, rows.put, [probes])
    start_s = time.monotonic()
    runner.start()
    rows.wait(lambda: len(rows.of("hanging")) >= 4)
    rows.wait(lambda: len(rows.of("counting")) >= 2)
    assert Path(f"{file}.looks").read_text() == "x", "a second look while the first one hangs"
    file.touch()
    rows.wait(lambda: rows.of("hanging")[-1]["ok"] is True)
    runner.close()
    silent = [row for row in rows.of("hanging") if row["ok"] is not True]
    text = "hangs for 0.15 s or longer"
    assert silent[:4] == [{"subject": str(file), "ok": None, "error": text, "n": None}] * 4
    first_s = next(at_s for at_s, order, _ in rows.all if order.kind == "hanging")
    assert first_s - start_s >= 0.15
    assert len(Path(f"{file}.looks").read_text()) >= 2


def test_what_a_look_that_hung_finds_at_last_is_dropped(probes: Path, tmp_path: Path) -> None:
    rows, file = Rows(), tmp_path / "there"
    code = (probes / "hanging.py").read_text().replace("PERIOD_S = 0.05", "PERIOD_S = 0.4")
    (probes / "hanging.py").write_text(code)
    runner = ProbeRunner([ProbeOrder("hanging", str(file))], rows.put, [probes])
    runner.start()
    rows.wait(lambda: rows.all)
    file.touch()
    rows.wait(lambda: rows.all[-1][2]["ok"] is True)
    runner.close()
    assert len(Path(f"{file}.looks").read_text()) >= 2, "the row is of the second look"


@pytest.mark.parametrize(
    ("how", "error"),
    [
        ("system", "/there/is/no/such/file: No such file or directory"),
        ("zero", "crashed: ZeroDivisionError: one by zero"),
        ("more", "crashed: ProbeDefectError: it gives 'm', which its MEASURES do not name"),
        ("type", "crashed: ValueError: invalid literal for int() with base 10: 'seven'"),
        ("nothing", "crashed: KeyError: 'ok'"),
    ],
)
def test_a_probe_that_fails_is_unknown_with_the_reason_and_looks_again(
    probes: Path, how: str, error: str
) -> None:
    rows = Rows()
    runner = ProbeRunner([ProbeOrder("failing", how)], rows.put, [probes])
    runner.start()
    rows.wait(lambda: len(rows.all) >= 2)
    runner.close()
    assert rows.all[0][2] == {"subject": how, "ok": None, "error": error, "n": None}


def test_a_probe_that_is_not_there_or_does_not_load_is_unknown(probes: Path) -> None:
    (probes / "torn.py").write_text("MEASURES, SUBJECT = {}, ''\ndef measure(:\n")
    rows = Rows()
    orders = [ProbeOrder("countin", "a"), ProbeOrder("torn", "a")]
    runner = ProbeRunner(orders, rows.put, [probes])
    runner.start()
    rows.wait(lambda: rows.of("countin") and rows.of("torn"))
    runner.close()
    missing, torn = rows.of("countin")[0], rows.of("torn")[0]
    assert missing["ok"] is None
    assert "there is no probe 'countin'" in missing["error"]
    assert "did you mean 'counting'" in missing["error"]
    assert torn["ok"] is None
    assert "probe 'torn' cannot be loaded: SyntaxError" in torn["error"]


def test_nothing_is_put_after_close_not_even_by_a_look_under_way(
    probes: Path, tmp_path: Path
) -> None:
    rows, file = Rows(), tmp_path / "there"
    orders = [ProbeOrder("hanging", str(file)), ProbeOrder("counting", "a")]
    runner = ProbeRunner(orders, rows.put, [probes])
    runner.start()
    rows.wait(lambda: len(rows.all) >= 2)
    runner.close()
    count = len(rows.all)
    file.touch()
    for thread in threading.enumerate():
        if thread.name == f"probe hanging {file}":
            thread.join(PATIENCE_S)
    assert len(rows.all) == count
    assert "probe counting a" not in [thread.name for thread in threading.enumerate()]


def test_what_put_raises_comes_out_of_close(probes: Path) -> None:
    asked = threading.Event()

    def put(order: ProbeOrder, row: Row) -> None:
        asked.set()
        raise OSError("the disk is full")

    runner = ProbeRunner([ProbeOrder("counting", "a")], put, [probes])
    runner.start()
    assert asked.wait(PATIENCE_S)
    with pytest.raises(OSError, match="the disk is full"):
        runner.close()
    assert isinstance(runner.failure, OSError)


def test_without_orders_nothing_runs() -> None:
    before = threading.active_count()
    runner = ProbeRunner([], Rows().put)
    runner.start()
    assert threading.active_count() == before
    runner.close()


def test_an_order_that_comes_twice_runs_once(probes: Path) -> None:
    rows = Rows()
    runner = ProbeRunner([ProbeOrder("counting", "a")] * 2, rows.put, [probes])
    runner.start()
    rows.wait(lambda: len(rows.all) >= 3)
    runner.close()
    assert [row["n"] for row in rows.of("counting")][:3] == [0, 1, 2]
