"""Present names of Amberbox that people and programs use from outside."""

from __future__ import annotations

import importlib.metadata
import json
import re
import sqlite3
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.compatibility.heirlooms import Person, amberbox
from tools.findings import ROOT

Names = dict[str, str]
"""What a name is of, and the names in one line."""

_NUMBERS = (
    (re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}"), "UUID"),
    (re.compile(r"\d{4}-\d\d-\d\d-\d{6}-[0-9a-f]{4}"), "INCIDENT"),
    (re.compile(r"\d{6}-[0-9a-z]{8}-\d{4}"), "RUN-BOOT-NUMBER"),
    (re.compile(r"[0-9a-f]{64}"), "SHA256"),
)


def commands() -> Names:
    """Return the options of each verb and of its words."""
    found = {}
    verbs = re.findall(r"^  ([a-z][a-z-]*)  +\S", amberbox("--help").out, re.M)
    for verb in verbs:
        text = amberbox(verb, "--help").out
        found[f"amberbox {verb}"] = _options(text)
        for word in re.findall(r"^    ([a-z][a-z-]*)  +\S", text, re.M):
            found[f"amberbox {verb} {word}"] = _options(amberbox(verb, word, "--help").out)
    return found


def _options(text: str) -> str:
    lines = re.findall(r"^  (-\S.*?)(?:  |$)", text, re.M)
    found = {one for line in lines for one in re.findall(r"(?<!\S)--?[\w-]+", line)}
    usage = text.partition("\n\n")[0]
    found |= set(re.findall(r"(?<![\w.-])[a-z][a-z-]+(?![\w.])", usage)) - {"usage", "options"}
    return " ".join(sorted(found))


def plugins() -> Names:
    """Return each plugin with its keys."""
    found = {}
    for one in json.loads(amberbox("plugins", "--json").out):
        said = amberbox("plugins", one["name"], "--kind", one["kind"], "--json").json()
        about = said[0] if isinstance(said, list) else said
        found[f"{one['kind']} {one['name']}"] = " ".join(
            [*sorted(set(_keys(about))), *(f"result:{r['name']}" for r in about.get("results", ()))]
        )
    return found


def _keys(about: Any) -> Iterator[str]:
    if isinstance(about, dict):
        if "key" in about:
            yield from (about["key"], *about.get("aliases", ()))
        about = list(about.values())
    if isinstance(about, list):
        for one in about:
            yield from _keys(one)


def package() -> Names:
    """Return what the installed package is known by."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    scripts = importlib.metadata.distribution("amberbox").entry_points
    return {
        "name": project["name"],
        "extras": " ".join(sorted(project["optional-dependencies"])),
        "scripts": " ".join(sorted(one.name for one in scripts.select(group="console_scripts"))),
    }


def routes(person: Person) -> Names:
    """Return what each route of the API takes and gives, field by field; no names of classes."""
    said = person.get("/openapi.json")
    found = {}
    for path, methods in said["paths"].items():
        for method, about in methods.items():
            takes = [f"{one['in']}:{one['name']}" for one in about.get("parameters", ())]
            body = about.get("requestBody", {}).get("content", {})
            takes += [f"body:{one}" for kind in body.values() for one in _fields(said, kind)]
            gives = [
                one
                for status, answer in about["responses"].items() if status.startswith("2")
                for kind in answer.get("content", {}).values() for one in _fields(said, kind)
            ]  # fmt: skip
            name = f"{method.upper()} {path}"
            found[name] = " ".join([*sorted(set(takes)), "->", *sorted(set(gives))])
    return found


def _fields(said: Any, kind: Any) -> Iterator[str]:
    yield from _walked(said, kind.get("schema", {}), "", ())


def _walked(said: Any, schema: Any, where: str, within: tuple[str, ...]) -> Iterator[str]:
    reference = schema.get("$ref", "")
    if reference in within:
        return
    if reference:
        target: Any = said
        for step in reference.removeprefix("#/").split("/"):
            target = target[step]
        yield from _walked(said, target, where, (*within, reference))
    for choice in ("anyOf", "oneOf", "allOf"):
        for one in schema.get(choice, ()):
            yield from _walked(said, one, where, within)
    if "enum" in schema or "const" in schema:
        values = schema.get("enum", [schema.get("const")])
        yield f"{where}={'|'.join(sorted(map(str, values)))}"
    if isinstance(schema.get("items"), dict):
        yield from _walked(said, schema["items"], f"{where}[]", within)
    if isinstance(schema.get("additionalProperties"), dict):
        yield from _walked(said, schema["additionalProperties"], f"{where}.*", within)
    for name, one in schema.get("properties", {}).items():
        inner = f"{where}.{name}" if where else name
        yield inner
        yield from _walked(said, one, inner, within)


def tables(database: Path) -> Names:
    """Return the columns of each table of a server's database."""
    with sqlite3.connect(database) as connection:
        found = {}
        every = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        for (name,) in every.fetchall():
            columns = connection.execute(f"PRAGMA table_info({name})").fetchall()
            if not name.startswith("sqlite_"):
                found[name] = " ".join(sorted(column[1] for column in columns))
    connection.close()
    return found


def channels(where: Path) -> Names:
    """Return the columns of what the box records of itself."""
    items = amberbox("items", where, "--all", "--json").json()
    found = {}
    for one in items:
        if one["name"].startswith("amberbox_"):
            said = amberbox("query", where, one["name"], "--format", "csv").out
            found[f"{one['topic']} {one['name']}"] = " ".join(
                sorted(said.split("\n", 1)[0].split(","))
            )
    return found


def files(folder: Path) -> Names:
    """Return the names of files and folders, without their numbers."""
    found = set()
    for path in folder.rglob("*"):
        name = str(path.relative_to(folder))
        for pattern, word in _NUMBERS:
            name = pattern.sub(word, name)
        found.add(name)
    return dict.fromkeys(sorted(found), "")
