"""The models of a robot folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import pytest

from amberbox.agent.folder_upload import packed_folder
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.blackbox.store.store import create_store
from amberbox.cli.main import main
from amberbox.core.errors import ConfigurationError, UsageError
from amberbox.diagnosis.models import (
    LONGEST_TEXT,
    MOST_BYTES,
    MOST_MODELS,
    check_models,
    find_model,
    models_of,
    read_models,
    trees_of,
)
from amberbox.link.folders import unpack
from tests.cli.test_consistency import POLYBOX
from tests.cli.test_structure import WHEEL


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    folder = tmp_path / "robot"
    (folder / "models").mkdir(parents=True)
    (folder / "robot.yaml").write_text("id: carrier\n")
    (folder / "black_box.yaml").write_text("- zmq: {endpoint: tcp://127.0.0.1:5560}\n")
    (folder / "models" / "wheel.yaml").write_text(WHEEL)
    (folder / "models" / "polybox.yaml").write_text(POLYBOX)
    return folder


def write(robot: Path, files: Mapping[str, str]) -> None:
    for name, text in files.items():
        (robot / "models" / name).write_text(text)


def test_models_by_kind_and_name(robot: Path) -> None:
    write(robot, {".hidden.yaml": WHEEL, "arm.yaml": WHEEL, "notes.md": "kind: equations"})
    found = models_of(robot)
    assert {kind: list(files) for kind, files in found.items()} == {
        "components": ["polybox"],
        "equations": ["arm", "wheel"],
    }
    assert found["equations"]["arm"] == robot / "models" / "arm.yaml"
    assert check_models(robot)[1] == []
    assert models_of(robot / "components") == {"components": {}, "equations": {}}


def test_one_of_several(robot: Path) -> None:
    assert find_model(robot, "equations").name == "wheel"
    write(robot, {"arm.yaml": WHEEL})
    assert find_model(robot, "equations", "wheel").path.name == "wheel.yaml"
    with pytest.raises(UsageError, match="2 models of kind: equations") as several:
        find_model(robot, "equations")
    assert several.value.hint == "models of kind equations: arm, wheel"
    with pytest.raises(UsageError, match="called 'wheels'; did you mean 'wheel'"):
        find_model(robot, "equations", "wheels")
    (robot / "wheel.yaml").write_text(WHEEL)
    with pytest.raises(UsageError, match=r"called '\.\./wheel'"):
        find_model(robot, "equations", "../wheel")
    (robot / "models" / "polybox.yaml").unlink()
    with pytest.raises(UsageError, match="no model of kind: components"):
        find_model(robot, "components")


def test_check_names_what_is_wrong(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(
        robot,
        {
            "wheel.yaml": WHEEL.replace("[ammeter, current]", "[ammeter, curent]"),
            "other.yaml": "kind: equation\n",
            "camera.yaml": "width: 640\n",
            "a b.yaml": WHEEL,
            "bent.yaml": "kind: [\n",
        },
    )
    assert main(["check", str(robot)]) == 2
    shown = capsys.readouterr().out
    place = robot / "models"
    assert f"{place}/wheel.yaml:10: equations.ammeter: there is no variable 'curent'" in shown
    assert "did you mean 'current'?" in shown
    assert f"{place}/other.yaml:1: kind: there are no models of kind 'equation'" in shown
    assert "did you mean 'equations'?\n  hint: kinds of models: components, equations" in shown
    assert f"{place}/camera.yaml:1: note: file: is no model and not used" in shown
    assert f"{place}/a b.yaml:1: file: its name is no name of a model" in shown
    assert f"{place}/bent.yaml:2: syntax" in shown
    assert main(["check", str(robot), "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["models"] == [
        {"name": "polybox", "kind": "components"}
    ]


def test_check_lists_models(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(robot)]) == 0
    assert "models:\n  polybox  components\n  wheel    equations\n" in capsys.readouterr().out


GATES = """<opsa-mef><define-fault-tree name="arm">
<define-gate name="stuck"><label>the arm is stuck</label>
  <or><event name="brake"/><event name="drives"/></or></define-gate>
<define-gate name="drives"><and><event name="left"/><event name="right"/></and></define-gate>
</define-fault-tree></opsa-mef>"""
EVENTS = """<opsa-mef><model-data>
<define-basic-event name="brake"><float value="0.01"/></define-basic-event>
<define-basic-event name="left"><float value="0.1"/></define-basic-event>
<define-basic-event name="right"><float value="0.2"/></define-basic-event>
</model-data></opsa-mef>"""


def test_fault_trees_of_several_files(robot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert trees_of(robot) == {}
    write(robot, {"a.xml": GATES, "b.xml": EVENTS})
    (tree,) = trees_of(robot).values()
    assert (tree.top, set(tree.events)) == ("stuck", {"brake", "left", "right"})
    assert main(["check", str(robot)]) == 0
    (robot / "fmea.yaml").write_text(FMEA)
    assert main(["faulttree", str(robot), "--effect", "stuck", "--cut-sets", "2"]) == 0
    assert "stuck (the arm is stuck)" in capsys.readouterr().out
    assert main(["faulttree", str(robot), "--effect", "stuk"]) == 2
    assert "did you mean 'stuck'?" in capsys.readouterr().err
    (robot / "fmea.yaml").unlink()
    assert {"models/a.xml", "models/b.xml"} <= {*unpack(packed_folder(load_folder(robot)))}
    write(robot, {"b.xml": EVENTS.replace('"left"', '"lift"')})
    capsys.readouterr()
    assert main(["check", str(robot)]) == 2
    place = robot / "models" / "a.xml"
    shown = capsys.readouterr().out
    assert f"{place}:" in shown and "did you mean 'lift'?" in shown
    (robot / "outside.xml").write_text(EVENTS)
    (robot / "models" / "b.xml").unlink()
    (robot / "models" / "b.xml").symlink_to("/etc/hostname")
    with pytest.raises(ConfigurationError, match="lies outside of the folder"):
        trees_of(robot)


FMEA = """\
instances: {box: [m1]}
types:
  box: {modes: {jammed: {probability: 0.001, unobservable: no sensor}}}
"""


def test_check_compares_maps_to_with_the_failure_modes(
    robot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (robot / "fmea.yaml").write_text(FMEA)
    write(robot, {"polybox.yaml": POLYBOX + 'maps_to: {M1: ["m1#jammed", "unknown#other"]}\n'})
    assert main(["check", str(robot)]) == 0, capsys.readouterr().out
    write(robot, {"polybox.yaml": POLYBOX + 'maps_to: {M1: ["m1#jamed"]}\n'})
    assert main(["check", str(robot)]) == 2
    shown = capsys.readouterr().out
    line = POLYBOX.count("\n") + 1
    assert f"polybox.yaml:{line}: maps_to.M1: there is no failure mode 'm1#jamed'" in shown
    assert "did you mean 'm1#jammed'?" in shown


def test_number_and_size_are_bounded(robot: Path) -> None:
    write(robot, {"large.yaml": WHEEL + "#" * MOST_BYTES})
    found, problems = read_models(robot)
    assert [model.name for model in found] == ["polybox", "wheel"]
    assert "at most 2,000,000 are read" in problems[0].what
    write(robot, {"large.yaml": WHEEL.replace("weak", "w" * (LONGEST_TEXT + 1))})
    assert "a text has 1,001 characters; at most 1,000" in read_models(robot)[1][0].what
    write(robot, {"large.yaml": WHEEL.replace("  motor:", f"  {'m' * (LONGEST_TEXT + 1)}:")})
    assert read_models(robot)[1][0].line == 5
    write(robot, {f"m{number}.yaml": "" for number in range(MOST_MODELS)})
    found, problems = read_models(robot)
    assert found == [] and "at most 100 are allowed" in problems[0].what


def test_models_are_part_of_the_folder_that_a_server_gets(robot: Path) -> None:
    folder = load_folder(robot)
    files = unpack(packed_folder(folder))
    assert files["models/wheel.yaml"].decode() == WHEEL
    write(robot, {"wheel.yaml": WHEEL + "# changed\n"})
    assert load_folder(robot).config_hash != folder.config_hash


def test_where_is_a_folder_its_record_or_a_file(
    robot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    create_store(robot / "store")
    wheel = robot / "models" / "wheel.yaml"
    for where in (robot, robot / "store", wheel):
        assert main(["structure", str(where), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["model"] == str(wheel)
    assert main(["consistency", str(robot), "polybox", "--observe", "M1.out=4"]) == 0
    assert "M1=broken" in capsys.readouterr().out
    assert main(["structure", str(robot), "--mso", "arm"]) == 2
    assert "called 'arm'" in capsys.readouterr().err
    assert main(["structure", str(wheel), "arm"]) == 2
    assert f"{wheel} is one model's file" in capsys.readouterr().err
    assert main(["structure", str(robot / "nothing.yaml")]) == 2
