"""The ``ethercat`` block: errors with key and reason, layouts of elements."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.blackbox.columns.frame_layout import read_layout
from amberbox.blackbox.ethercat.images import ElementOptions, InterfaceOptions
from amberbox.blackbox.ethercat.options import EtherCatOptions, read_block
from amberbox.core.config import build
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.yaml_nodes import parse_yaml


def problems(text: str) -> str:
    found: list[Problem] = []
    node = parse_yaml(f"interfaces: [{text}]", "black_box.yaml", found)
    assert node is not None
    build(EtherCatOptions, node, found, "ethercat")
    return "; ".join(f"{problem.where}: {problem.what}" for problem in found)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("{interface: eth1, output_message_elements: [{name: a, type: unit8}]}", "mean 'uint8'"),
        ("{interface: eth1, output_message_size: 1, output_message_elements: "
         "[{name: a, type: uint16}]}", "take 2 bytes, output_message_size is 1"),
        ("{interface: eth1, input_message_elements: [{name: a, type: uint8},"
         " {name: a, type: uint8}]}", "a is there twice"),
        ("{interface: eth1, input_message_elements: [{name: a, type: uint8, bit: 1}]}", "bool"),
        ("{interface: eth1, number_of_slaves: 0}", "must be 1 to 1000"),
        ("{interface: eth1, input_address: -1}", "32 bits"),
        ("{interface: ''}", "names no interface"),
        ("{interface: eth1}, {interface: eth1}", "eth1 is there twice"),
        ("{interface: eth1, debounce_cycles: 0, buffer_mb: 0}", "must be 1 to 1024"),
        ("{interface: eth1, output_data_items: {name: bus}, output_message_elements: "
         "[{name: a, type: uint8}]}", "two messages are called 'bus'"),
    ],
)  # fmt: skip
def test_errors(text: str, error: str) -> None:
    assert error in problems(text)


def test_elements_have_offsets_and_bits() -> None:
    one = InterfaceOptions(
        "eth1",
        input_message_elements=[
            ElementOptions("ready", "bool"),
            ElementOptions("fault", "bool"),
            ElementOptions("speed", "int16"),
            ElementOptions("door", "bool", offset=8, bit=5),
            ElementOptions("level", "double", offset=16),
        ],
    )
    topic = one.topic("input")
    assert topic is not None and topic.schema is not None
    layout = read_layout(topic.schema)
    assert [(f.name, f.bit, f.bits) for f in layout.fields] == [
        ("ready", 0, 1), ("fault", 1, 1), ("speed", 8, 16), ("door", 69, 1), ("level", 128, 64),
    ]  # fmt: skip
    assert layout.size == 24


def test_a_file_with_the_block(tmp_path: Path) -> None:
    path = tmp_path / "black_box.yaml"
    path.write_text("- ros: {}\n- ethercat: {interfaces: [{interface: eth1}]}\n")
    assert read_block(path).interfaces[0].interface == "eth1"
    path.write_text("- ros: {}\n")
    with pytest.raises(AmberboxError, match="no blocks 'ethercat:'"):
        read_block(path)
    with pytest.raises(AmberboxError, match="No such file"):
        read_block(tmp_path / "none.yaml")
