"""Topics and keys of any length and script: names, tables, exports, and stores of before."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import amberbox
from amberbox.cli.main import main
from amberbox.core.names import shortened
from amberbox.core.types import Topic
from tests.support.manual_recorder import ManualBox

TOPICS = ("/" + "x" * 5000, "/" + "x" * 4999 + "y", "/скорость", "/Skorost", "/速度")
MESSAGE = json.dumps({"скорость": 2.5, "温度": 3, "x": 1, "k" * 5000: 4}).encode()


def record(store: Path) -> None:
    box = ManualBox(store, source="zmq")
    for topic in TOPICS:
        box.hear(Topic(topic, "json"), MESSAGE)
    box.close()


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("foreign") / "store"
    record(path)
    return path


def test_words_of_other_scripts_stay_readable_and_paths_exact(store: Path) -> None:
    record = amberbox.open(store)
    items = [item.name for item in record.items() if item.name.startswith("zmq")]
    assert {"zmq_skorost", "zmq_u901fu5ea6"} < set(items)
    assert len({name.casefold() for name in items}) == len(TOPICS)
    columns = {column.path: column.name for column in record.variables("zmq_skorost").columns}
    assert columns["скорость"] == "skorost" and columns["温度"] == "u6e29u5ea6"
    assert len(columns["k" * 5000]) == 128
    assert record.query("zmq_skorost", ["skorost"]).values("skorost") == [2.5]


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_everything_is_exported(store: Path, tmp_path: Path, form: str) -> None:
    target = tmp_path / "out"
    assert main(["export", str(store), "-o", str(target), "--format", form]) == 0
    names = [path.stem for path in target.iterdir()]
    assert len(names) == len(TOPICS) and max(map(len, names)) <= 200


def test_tables_stay_narrow(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["items", str(store)]) == 0
    assert main(["query", str(store), "zmq_skorost"]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) < 400


def test_files_of_items_with_names_of_any_length_have_short_and_distinct_names() -> None:
    long = ["zmq_" + "x" * 5000 + end for end in ("a", "b")]
    assert len({shortened(name) for name in long}) == 2
    assert max(len(shortened(name)) for name in long) == 200
    assert shortened("ros_odom") == "ros_odom"


def test_a_store_of_before_keeps_its_names(tmp_path: Path) -> None:
    store = tmp_path / "store"
    ManualBox(store, source="zmq").close()
    (store / "names.json").write_text(json.dumps({"zmq скорость": "zmq_________"}))
    box = ManualBox(store, source="zmq")
    box.hear(Topic("/скорость", "json"), MESSAGE)
    box.hear(Topic("/скорость/2", "json"), MESSAGE)
    box.close()
    columns = amberbox.open(store).variables("zmq_________").columns
    assert [column.name for column in columns][:2] == ["________", "__"]
    assert "zmq_skorost_2" in [item.name for item in amberbox.open(store).items()]
