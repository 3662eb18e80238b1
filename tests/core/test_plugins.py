"""Plugins are found by file name, without running them."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.core import plugins
from amberbox.core.errors import AmberboxError, UsageError


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A package with two plugins, a helper, a broken module, and one that must not be run."""
    name = f"plugs_{abs(hash(tmp_path))}"
    folder = tmp_path / name
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "sonar.py").write_text(
        '"""Listens to sonar.\n\nMore."""\nfrom x import Config\nclass Source: ...\n'
    )
    (folder / "import_.py").write_text('"""Imports."""\nConfig = Source = 1\n')
    (folder / "helper.py").write_text('"""Helps."""\ndef Source(): ...\n')
    (folder / "_private.py").write_text("Config = Source = 1\n")
    (folder / "broken.py").write_text("def (\n")
    (folder / "bomb.py").write_text("raise SystemExit(3)\nclass Config: ...\nclass Source: ...\n")
    (folder / "big").mkdir()
    (folder / "big" / "__init__.py").write_text(
        '"""Is a package."""\nclass Config: ...\nclass Source: ...\n'
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    return name


def test_names_and_summaries_without_importing(package: str) -> None:
    found = plugins.find(package, defines=("Config", "Source"))
    summaries = {name: plugin.summary for name, plugin in found.items()}
    assert summaries == {
        "big": "Is a package.",
        "bomb": "",
        "broken": "",
        "import": "Imports.",
        "sonar": "Listens to sonar.",
    }
    assert "helper" in plugins.find(package)


def test_load(package: str) -> None:
    found = plugins.find(package)
    assert found["import"].load().Config == 1
    with pytest.raises(AmberboxError, match="plugin 'sonar' cannot be loaded: No module named 'x'"):
        found["sonar"].load()


def test_unknown_name_gets_a_suggestion(package: str) -> None:
    with pytest.raises(UsageError, match="'sonra'; did you mean 'sonar'") as caught:
        plugins.get(package, "sonra")
    assert "sonar" in caught.value.hint
    assert plugins.get(package, "sonar").name == "sonar"


def test_extra_folders_come_after_the_package(package: str, tmp_path: Path) -> None:
    extra = tmp_path / "extra"
    extra.mkdir()
    (extra / "lidar.py").write_text('"""Listens to a lidar."""\nVALUE = 7\n')
    (extra / "sonar.py").write_text('"""Not this one."""\n')
    found = plugins.find(package, [extra, tmp_path / "absent"])
    assert found["lidar"].load().VALUE == 7
    assert found["sonar"].summary == "Listens to sonar."


def test_missing_packages_are_named(package: str, tmp_path: Path) -> None:
    (tmp_path / package / "late.py").write_text(
        "import os\ndef run():\n    import no_such_thing.sub\n    from nor_this import x\n"
    )
    late = plugins.find(package)["late"]
    assert plugins.missing_packages(late) == ["no_such_thing", "nor_this"]


def test_hint_names_the_extra_that_brings_it() -> None:
    assert plugins.install_hint("zmq") == "pip install 'amberbox[zmq]'"
    assert plugins.install_hint("sonar") == ""


def test_package_that_does_not_exist_has_no_plugins() -> None:
    assert plugins.find("amberbox.no_such.thing") == {}


def test_entry_points_of_other_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = tmp_path / "radar_for_amberbox-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: radar-for-amberbox\nVersion: 1.0\n"
    )
    (info / "entry_points.txt").write_text("[amberbox.sources]\nradar = radar_plugin\n")
    (tmp_path / "radar_plugin.py").write_text("VALUE = 5\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    radar = plugins.find("amberbox.blackbox.sources")["radar"]
    assert radar.summary == "From the package radar-for-amberbox."
    assert radar.load().VALUE == 5
