"""The source of versions: real git and dpkg, made-up environments, and an engine on a socket."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from socketserver import UnixStreamServer
from typing import Any

import pytest

import amberbox
from amberbox.blackbox.sources import versions
from amberbox.blackbox.sources.versions import Config, Source
from amberbox.core.config import build
from amberbox.core.errors import Problem
from amberbox.core.source import TopicOptions
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.testing.clock import PATIENCE_S, wait_until
from amberbox.testing.contract import MemorySink, ObservedSink, observe
from tests.support.manual_recorder import event_texts, raw_messages, recording

COMMIT = "0123456789abcdef0123456789abcdef01234567"


@contextmanager
def looking(kind: str, **options: Any) -> Iterator[ObservedSink]:
    config = Config(topics=[TopicOptions(kind)], **options)
    with observe(Source(config, "versions")) as sink:
        yield sink


def entries(kind: str, **options: Any) -> list[dict[str, Any]]:
    """Return what is found of a kind."""
    with looking(kind, **options) as sink:
        (row,) = [json.loads(data) for data in sink.wait_for(kind, 1)]
    assert row["count"] == len(row["entries"])
    found: list[dict[str, Any]] = row["entries"]
    return found


def trouble(kind: str, **options: Any) -> str:
    with looking(kind, **options) as sink:
        wait_until(lambda: sink.events, "it is told")
    return sink.events[0][1]


def git(folder: Path, *words: str) -> str:
    command = ["git", "-C", str(folder), "-c", "user.name=x", "-c", "user.email=x@y", *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Return a git working tree with one commit on the branch work/x."""
    folder = tmp_path / "drivers"
    folder.mkdir()
    git(folder, "init", "--quiet", "--initial-branch=work/x")
    (folder / "a.txt").write_text("1\n")
    git(folder, "add", ".")
    git(folder, "commit", "--quiet", "-m", "one")
    return folder


def test_this_computer_and_amberbox() -> None:
    found = {entry["name"]: entry["version"] for entry in entries("system")}
    assert found["kernel"] == platform.release() and found["os"]
    found = {entry["name"]: entry["version"] for entry in entries("amberbox")}
    assert found == {"amberbox": amberbox.__version__, "python": platform.python_version()}


@pytest.mark.skipif(shutil.which("dpkg-query") is None, reason="no Debian")
def test_debian_packages_by_name_and_pattern() -> None:
    found = {e["name"]: e["version"] for e in entries("debian", debian=["dpkg", "coreut*", "no-x"])}
    command = ["dpkg-query", "--show", "--showformat=${Version}", "dpkg"]
    version = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert found["dpkg"] == version and found.keys() == {"dpkg", "coreutils"}


def test_python_packages_of_an_environment(tmp_path: Path) -> None:
    packages = tmp_path / "env" / "lib" / "python3.11" / "site-packages"
    for name in (
        "numpy-2.1.0.dist-info",
        "ruamel.yaml-0.18.dist-info",
        "old_tool-1.0-py3.egg-info",
    ):
        (packages / name).mkdir(parents=True)
    (packages / "linked.egg-info").mkdir()
    (packages / "linked.egg-info" / "PKG-INFO").write_text("Name: linked\nVersion: 3.2\n")
    (packages / "broken.egg-info").mkdir()
    found = entries("python", python={"nav": str(tmp_path / "env")})
    assert {(e["name"], e["version"], e["environment"]) for e in found} == {
        ("numpy", "2.1.0", "nav"),
        ("ruamel.yaml", "0.18", "nav"),
        ("old_tool", "1.0", "nav"),
        ("linked", "3.2", "nav"),
        ("broken", "", "nav"),
    }


def test_a_missing_environment_does_not_hide_the_others(tmp_path: Path) -> None:
    (tmp_path / "a-1.dist-info").mkdir()
    both = {"gone": "/no/such/environment", "there": str(tmp_path)}
    with looking("python", python=both) as sink:
        (data,) = sink.wait_for("python", 1)
    assert [entry["name"] for entry in json.loads(data)["entries"]] == ["a"]
    assert sink.events[0][:2] == (
        "versions_incomplete",
        "python: there is no environment /no/such/environment",
    )


def test_commits_of_working_trees(tree: Path, tmp_path: Path) -> None:
    commit = git(tree, "rev-parse", "HEAD")
    linked = tmp_path / "linked"
    git(tree, "worktree", "add", "--quiet", "--detach", str(linked))
    git(tree, "pack-refs", "--all")
    (tree / "new.txt").write_text("an untracked file is no change\n")
    trees = {"drivers": str(tree), "linked": str(linked)}
    first, second = entries("git", git=trees)
    assert (first["commit"], first["branch"], first["dirty"]) == (commit, "work/x", False)
    assert (second["commit"], second["branch"], second["dirty"]) == (commit, "", False)
    git(linked, "switch", "--quiet", "--create", "other")
    (linked / "a.txt").write_text("2\n")
    first, second = entries("git", git=trees)
    assert (second["commit"], second["branch"], second["dirty"]) == (commit, "other", True)
    assert first["dirty"] is False


def test_no_program_of_a_working_tree_is_run(tree: Path, tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    script = tmp_path / "hook"
    script.write_text(f"#!/bin/sh\ntouch {mark}\n")
    script.chmod(0o755)
    git(tree, "config", "core.fsmonitor", str(script))
    git(tree, "config", "core.hooksPath", str(tmp_path))
    for hook in ("post-index-change", "post-checkout"):
        shutil.copy2(script, tree / ".git" / "hooks" / hook)
        shutil.copy2(script, tmp_path / hook)
    index = (tree / ".git" / "index").read_bytes()
    os.utime(tree / "a.txt", (1e9, 1e9))
    (found,) = entries("git", git={"drivers": str(tree)})
    assert found["dirty"] is False and not mark.exists()
    assert (tree / ".git" / "index").read_bytes() == index, "it is only read"


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a folder away")
def test_of_a_tree_of_another_user_the_commit_is_known(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / ".gitconfig").write_text("[safe]\n\tdirectory = *\n")
    monkeypatch.setenv("HOME", str(tmp_path))
    commit = git(tree, "rev-parse", "HEAD")
    for path in (tree, *tree.rglob("*")):
        os.chown(path, 12345, 12345)
    (found,) = entries("git", git={"drivers": str(tree)})
    assert (found["commit"], found["branch"], found["dirty"]) == (commit, "work/x", None)
    assert "another user" in found["why"]


@pytest.mark.parametrize(
    ("head", "words"),
    [
        ("ref: refs/../../../etc/passwd", "which is no branch"),
        ("ref: /etc/passwd", "which is no branch"),
        ("$(reboot)", "is no commit"),
        (None, "is no git working tree"),
    ],
)
def test_a_broken_tree_is_told_and_the_others_are_read(
    tree: Path, tmp_path: Path, head: str | None, words: str
) -> None:
    broken = tmp_path / "broken" / ".git"
    broken.mkdir(parents=True)
    if head is not None:
        (broken / "HEAD").write_text(head)
    trees = {"broken": str(broken.parent), "drivers": str(tree)}
    with looking("git", git=trees) as sink:
        (data,) = sink.wait_for("git", 1)
    assert [entry["name"] for entry in json.loads(data)["entries"]] == ["drivers"]
    assert words in sink.events[0][1]


def test_ros_packages(tmp_path: Path) -> None:
    texts = {
        "noetic/share/tf2": "<package a='2'><name>tf2</name><version>0.7.7</version></package>",
        "ws/src/driver": '<package>\n<name>driver</name><version compatibility="1">1.0\n</version>',
        "ws/src/tf2": "<package><name>tf2</name><version>9</version></package>",
        "ws/src/none": "<package>" * 1000,
    }
    for place, text in texts.items():
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "package.xml").write_text(text)
    folders = [str(tmp_path / "noetic"), str(tmp_path / "ws")]
    found = {(e["name"], e["version"]) for e in entries("ros", ros=folders)}
    assert found == {("tf2", "0.7.7"), ("driver", "1.0")}
    assert "there is no folder" in trouble("ros", ros=[str(tmp_path / "gone")])


class Engine(BaseHTTPRequestHandler):
    """Containers of an engine."""

    answer: bytes = b""

    def do_GET(self) -> None:
        assert self.path == "/containers/json?all=true"
        self.send_response(200)
        self.end_headers()
        self.wfile.write(self.answer)

    def address_string(self) -> str:
        return "socket"

    def log_message(self, format: str, *args: Any) -> None:
        """Suppress the log."""


@pytest.fixture
def engine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    path = tmp_path / "docker.sock"
    monkeypatch.setattr(versions, "engine_sockets", lambda: [path])
    with UnixStreamServer(str(path), Engine) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield
        server.shutdown()
        thread.join(PATIENCE_S)


def test_images_of_containers(engine: None, monkeypatch: pytest.MonkeyPatch) -> None:
    known: list[Any] = [
        {"Names": ["/rosbridge"], "Image": "ros:noetic", "ImageID": f"sha256:{COMMIT}",
         "State": "running"},
        {"Id": "abc", "Image": None},
        "hostile",
    ]  # fmt: skip
    monkeypatch.setattr(Engine, "answer", json.dumps(known).encode())
    first, second = entries("containers")
    assert first == {
        "name": "rosbridge",
        "version": "ros:noetic 0123456789ab",
        "image": "ros:noetic",
        "image_id": f"sha256:{COMMIT}",
        "state": "running",
    }
    assert second["name"] == "abc"
    monkeypatch.setattr(Engine, "answer", b"[" * 100_000)
    assert "is no JSON" in trouble("containers")


def test_a_program_that_hangs_floods_or_is_missing_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "dpkg-query cannot be started" in trouble("debian", debian=["x"])
    program = tmp_path / "dpkg-query"
    program.write_text("#!/bin/sh\nwhile :; do echo 'a\t1\tii'; done\n")
    program.chmod(0o755)
    assert "prints more than" in trouble("debian", debian=["x"])
    program.write_text("#!/bin/sh\nexec /bin/sleep 600\n")
    monkeypatch.setattr(versions, "_WAIT_S", 0.2)
    assert "has no answer within 0.2 s" in trouble("debian", debian=["x"])


def test_too_many_entries_are_left_out_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(versions, "MOST", 3)
    for number in range(4):
        (tmp_path / f"p{number}-1.dist-info").mkdir()
    assert len(entries("python", python={"nav": str(tmp_path)})) == 3
    assert "only the first 3 are recorded" in trouble("python", python={"nav": str(tmp_path)})


def folder_of(tmp_path: Path, options: Mapping[str, Any]) -> Path:
    folder = tmp_path / "robot"
    folder.mkdir()
    (folder / "robot.yaml").write_text("id: r1\nstore: {path: store}\n")
    (folder / "black_box.yaml").write_text(json.dumps([{"versions": options}]))
    return folder


def test_a_change_between_runs_is_an_event(tmp_path: Path) -> None:
    packages = tmp_path / "env"
    packages.mkdir()
    names = ["navigation-1.2.0.dist-info", "old-1.dist-info", "same-5.dist-info"]
    for name in names:
        (packages / name).mkdir()
    options = {"python": {"nav": "../env", "gone": "../gone"}, "topics": [{"name": "python"}]}
    folder = folder_of(tmp_path, options)

    def run(times: int) -> None:
        with recording(folder):
            wait_until(
                lambda: len(raw_messages(folder / "store", "python")) == times, "it is recorded"
            )

    run(1)
    assert event_texts(folder / "store", "version_changed") == []
    (packages / names[0]).rename(packages / "navigation-1.3.0.dist-info")
    (packages / names[1]).rmdir()
    (packages / "new-2.dist-info").mkdir()
    run(2)
    run(3)
    assert event_texts(folder / "store", "version_changed") == [
        "navigation (nav) 1.2.0 -> 1.3.0",
        "new (nav) 2 is new",
        "old (nav) 1 is gone",
    ]
    shutil.rmtree(packages)
    run(4)
    assert len(event_texts(folder / "store", "version_changed")) == 3, "it cannot be read"
    table = amberbox.open(folder).query("versions_python__entries", ["name", "version"])
    assert "navigation" in list(table.values("name"))


def test_it_looks_again_within_a_run(tree: Path) -> None:
    with looking("git", git={"drivers": str(tree)}, every_s=1.0) as sink:
        sink.wait_for("git", 1)
        (tree / "a.txt").write_text("2\n")
        wait_until(lambda: [kind for kind, *_ in sink.events] == ["version_changed"], "a change")
    assert sink.events[0][1].endswith("(work/x), changed")


def test_many_changes_are_summed_up(tmp_path: Path) -> None:
    for number in range(25):
        (tmp_path / f"p{number}-1.dist-info").mkdir()
    config = Config(python={"nav": str(tmp_path)}, topics=[TopicOptions("python")])
    sink = MemorySink()
    versions._Look(config, sink, threading.Event()).step()
    for number in range(25):
        (tmp_path / f"p{number}-1.dist-info").rename(tmp_path / f"p{number}-2.dist-info")
    versions._Look(config, sink, threading.Event()).step()
    assert len(sink.events) == 21
    assert sink.events[-1][1] == "python: 5 more have changed"


@pytest.mark.parametrize(
    ("block", "words"),
    [
        ("{every_s: 0}", "must be 1 s or more"),
        ("{debian: [--admindir=/]}", "is no name or pattern of a package"),
        ("{topics: [{topic: {name: pyton}}]}", "did you mean 'python'?"),
        ("{python: [x]}", "python"),
    ],
)
def test_wrong_options_are_named(block: str, words: str) -> None:
    problems: list[Problem] = []
    node = parse_yaml(block, "black_box.yaml", problems)
    assert node is not None
    build(Config, node, problems, "versions")
    assert words in "\n".join(str(problem) for problem in problems)
