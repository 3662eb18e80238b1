"""Documentation that is missing or leads nowhere is found; its examples run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from amberbox.cli.main import main
from tools.check_docs import broken_links, check, configuration_keys
from tools.findings import ROOT
from tools.markdown import anchors, fences, links, pages

PAGE = """# The box: `write_s` and more

See [format](format.md#bytes), [web](https://example.org), [here](#the-box-write_s-and-more).
`[not](a-link.md)`

```python run
[also](no-link.md)
# no heading
```
"""


def test_fences_links_and_headings_are_read() -> None:
    assert [(f.line, f.info, f.text.count("\n")) for f in fences(PAGE)] == [(6, "python run", 2)]
    assert [link.target for link in links(PAGE)] == [
        "format.md#bytes",
        "https://example.org",
        "#the-box-write_s-and-more",
    ]
    assert anchors(PAGE) == {"the-box-write_s-and-more"}


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[a](missing.md)", "missing.md leads nowhere"),
        ("[a](#missing)", "page.md has no heading #missing"),
        ("[a](other.md#missing)", "other.md has no heading #missing"),
        ("[a](other.md#there-it-is)", None),
        ("[a](https://example.org/missing.md#x)", None),
    ],
)
def test_broken_links_are_found(tmp_path: Path, text: str, complaint: str | None) -> None:
    (tmp_path / "other.md").write_text("## There it is\n")
    page = tmp_path / "page.md"
    page.write_text(f"{text}\n")
    found = [finding.what for finding in broken_links(page, tmp_path)]
    assert [complaint is not None and complaint in what for what in found] == [True] * bool(
        complaint
    )


def test_what_is_not_documented_is_found(tmp_path: Path) -> None:
    found = " ".join(finding.what for finding in check(tmp_path))
    assert "command 'amberbox record'" in found
    assert "monitor 'heartbeat' is not documented" in found
    assert "argument 'tolerance' of the monitor 'heartbeat' is not documented" in found
    assert "source 'ros'" in found
    assert "key 'max_frequency' of TopicOptions" in found


def test_what_is_documented_is_not_complained_about(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("`amberbox record X` listens to:\n\n- ros:\n")
    (tmp_path / "docs").mkdir()
    page = tmp_path / "docs" / "develop" / "design.md"
    page.parent.mkdir()
    page.write_text("`max_frequency` is only for insiders here")
    found = " ".join(finding.what for finding in check(tmp_path))
    assert "command 'amberbox record'" not in found
    assert "source 'ros'" not in found
    assert "command 'amberbox check'" in found
    assert "key 'max_frequency' of TopicOptions" in found


def test_configuration_keys_are_found() -> None:
    keys = {(name, key) for _, name, key in configuration_keys()}
    assert {("TopicOptions", "max_frequency"), ("ChangeOptions", "heartbeat_s")} <= keys


def test_design_notes_are_numbered() -> None:
    """001-why.md, 002-...: each number once, without a hole."""
    notes = sorted(path.name for path in (ROOT / "docs" / "develop" / "notes").iterdir())
    assert [name[:4] for name in notes] == [f"{n:03}-" for n in range(1, len(notes) + 1)]


def test_python_examples_run(tmp_path: Path) -> None:
    """Every fence marked ``python run`` is a program that ends well in an empty folder."""
    failures = []
    for page in pages():
        for fence in fences(page.read_text(encoding="utf-8")):
            if fence.info == "python run":
                command = [sys.executable, "-c", fence.text]
                done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
                if done.returncode:
                    failures.append(f"{page.name}:{fence.line}: {done.stderr}")
    assert failures == []


def test_black_boxes_in_the_documentation_are_accepted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every list of blocks in a ``yaml`` fence is a black_box.yaml that ``check`` takes."""
    checked, failures = 0, []
    for page in pages():
        for fence in fences(page.read_text(encoding="utf-8")):
            if fence.info == "yaml" and _is_black_box(yaml.safe_load(fence.text)):
                checked += 1
                status = _check_black_box(tmp_path / f"{page.stem}_{fence.line}", fence.text)
                said = "".join(capsys.readouterr())
                failures += [f"{page.name}:{fence.line}: {said}"] if status else []
    assert failures == []
    assert checked


def _is_black_box(data: object) -> bool:
    return isinstance(data, list) and all(isinstance(one, dict) and len(one) == 1 for one in data)


def _check_black_box(folder: Path, text: str) -> int:
    folder.mkdir()
    (folder / "robot.yaml").write_text("id: example\n")
    (folder / "black_box.yaml").write_text(text)
    return main(["check", str(folder)])
