"""Where something stands in the file."""

from __future__ import annotations

from amberbox.core.nodes import Node


def child(node: Node, *keys: str | int) -> Node:
    """Go down a tree by keys and places in lists, as far as it goes."""
    for key in keys:
        if isinstance(key, int):
            node = (node.items or ())[key] if key < len(node.items or ()) else node
        else:
            node = (node.mapping or {}).get(key, node)
    return node
