"""Planted imports against the directions are found, allowed ones are not."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.check_imports import check

MODULES = (
    "__init__",
    "core/__init__",
    "core/types",
    "blackbox/__init__",
    "blackbox/journal",
    "blackbox/recorder",
    "blackbox/query",
    "blackbox/sources/ros1/__init__",
    "blackbox/sources/__init__",
    "blackbox/sources/ros",
    "blackbox/sources/zmq",
    "monitoring/plan",
    "monitoring/modes/__init__",
    "monitoring/modes/device",
    "monitoring/modes/range",
    "monitoring/probes/__init__",
    "monitoring/probes/_ros",
    "monitoring/probes/ros_node",
    "diagnosis/covering",
    "server/app",
    "cli/record",
)


def tree(folder: Path, **planted: str) -> Path:
    """Make a package of empty modules; ``planted`` gives some of them a text."""
    source = folder / "src"
    for module in MODULES:
        path = source / "amberbox" / f"{module}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(planted.get(module.replace("/", "_"), ""))
    return source


@pytest.mark.parametrize(
    ("module", "text", "complaint"),
    [
        ("core_types", "import amberbox.blackbox.store.store", "may not know"),
        ("core_types", "from amberbox.blackbox import journal", "may not know"),
        ("core_types", "from ..blackbox import journal", "may not know"),
        ("core_types", "def f():\n    import amberbox.cli.record", "may not know"),
        ("blackbox_query", "from amberbox.server import app", "may not know"),
        (
            "diagnosis_covering",
            "from amberbox.blackbox.query.record import x",
            "may not know",
        ),
        ("server_app", "import amberbox.cli.record", "may not know"),
        ("blackbox_sources_ros", "from amberbox.blackbox.sources import zmq", "another plugin"),
        ("blackbox_sources_ros", "from . import zmq", "another plugin"),
        (
            "blackbox_sources_ros",
            "import amberbox.blackbox.store.store",
            "core and its protocol",
        ),
        (
            "monitoring_modes_device",
            "from amberbox.monitoring.modes import range",
            "another plugin",
        ),
        (
            "monitoring_modes_device",
            "import amberbox.blackbox.sources.ros1",
            "a mode knows core only",
        ),
        ("monitoring_modes_device", "from amberbox.monitoring import plan", "knows core only"),
        ("monitoring_probes_ros_node", "import amberbox.blackbox.query", "its protocol library"),
        ("monitoring_probes__ros", "import amberbox.monitoring.plan", "its protocol library"),
        ("monitoring_probes__ros", "from . import ros_node", "another plugin"),
        ("blackbox_query", "import pyarrow.parquet", "at its top"),
        ("blackbox_sources_zmq", "import zmq", "at its top"),
        ("cli_record", "try:\n    import polars\nexcept ImportError: pass", "at its top"),
        ("blackbox_recorder", "def f():\n    import pyarrow", "record process"),
        ("core_types", "def f():\n    from pyarrow import parquet", "record process"),
    ],
)
def test_a_forbidden_import_is_found(
    tmp_path: Path, module: str, text: str, complaint: str
) -> None:
    found = check(tree(tmp_path, **{module: text}))
    assert [complaint in finding.what for finding in found] == [True]
    assert found[0].line == len(text.splitlines()) - ("except" in text)


def test_pyarrow_is_found_behind_a_module_that_the_recorder_imports(tmp_path: Path) -> None:
    planted = {
        "blackbox_recorder": "from amberbox.blackbox import query",
        "blackbox_query": "def f():\n    import pyarrow",
    }
    assert ["record process" in f.what for f in check(tree(tmp_path, **planted))] == [True]


@pytest.mark.parametrize(
    ("planted", "cycle"),
    [
        (
            {
                "blackbox_query": "from amberbox.blackbox import recorder",
                "blackbox_recorder": "def f():\n    from amberbox.blackbox import query",
            },
            "amberbox.blackbox.query <- amberbox.blackbox.recorder",
        ),
        (
            {
                "blackbox_query": "import amberbox.blackbox.sources.zmq",
                "blackbox_sources_ros1___init__": (
                    "from typing import TYPE_CHECKING\n"
                    "if TYPE_CHECKING:\n    import amberbox.blackbox.query"
                ),
            },
            "query <- sources",
        ),
    ],
)
def test_a_cycle_is_found(tmp_path: Path, planted: dict[str, str], cycle: str) -> None:
    """Of files and of folders; imports in functions and for type checkers count."""
    found = [finding.what for finding in check(tree(tmp_path, **planted))]
    start, end = cycle.split(" <- ")
    assert any("cycle" in what and cycle in what + f" <- {start} <- {end}" for what in found)


def test_allowed_imports_are_not_complained_about(tmp_path: Path) -> None:
    planted = {
        "core_types": "from __future__ import annotations\nimport numpy",
        "blackbox_query": "from amberbox.core.types import x\ndef f():\n    import pyarrow",
        "blackbox_sources_ros": (
            "import amberbox.blackbox.sources.ros1\nfrom amberbox.core import types"
        ),
        "monitoring_modes_device": "from amberbox.core.types import x\nimport numpy",
        "monitoring_probes_ros_node": (
            "from amberbox.monitoring.probes._ros import x\nimport amberbox.core.types"
        ),
        "monitoring_probes__ros": "import amberbox.blackbox.sources.ros1",
        "monitoring_plan": "import amberbox.blackbox.query",
        "blackbox_sources_zmq": (
            "from typing import TYPE_CHECKING\n"
            "if TYPE_CHECKING:\n    import zmq\n"
            "def f():\n    import zmq"
        ),
        "server_app": "import amberbox.blackbox.query.record, amberbox.diagnosis.covering",
        "cli_record": "from amberbox.server import app\nfrom amberbox import __version__",
    }
    assert check(tree(tmp_path, **planted)) == []
