"""Messages of tf, serialised as ROS 1 and ROS 2 do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from amberbox.core.clock import NS
from amberbox.core.types import Schema, Topic

KIND = "tf2_msgs/msg/TFMessage"
STORE = get_typestore(Stores.ROS1_NOETIC)
STORE2 = get_typestore(Stores.ROS2_HUMBLE)
for _store in (STORE, STORE2):
    if KIND not in _store.types:
        _store.register(
            get_types_from_msg("geometry_msgs/msg/TransformStamped[] transforms\n", KIND)
        )
IDENTITY = (0.0, 0.0, 0.0, 1.0)

# parent, child, stamp in ns, translation, rotation x y z w
Sent = tuple[str, str, int, Sequence[float], Sequence[float]]


def tf_topic(name: str = "/tf", *, cdr: bool = False, latched: bool = False) -> Topic:
    """Return a topic of tf."""
    store = STORE2 if cdr else STORE
    text, _ = store.generate_msgdef(KIND, ros_version=2 if cdr else 1)
    kind = KIND if cdr else KIND.replace("/msg/", "/")
    schema = Schema(kind, "ros2msg" if cdr else "ros1msg", text.encode())
    return Topic(name, "cdr" if cdr else "ros1", schema, latched)


def tf_message(*transforms: Sent, cdr: bool = False) -> bytes:
    """Serialise a message of some transforms."""
    store: Any = STORE2 if cdr else STORE
    types = store.types
    made = []
    for parent, child, stamp_ns, translation, rotation in transforms:
        stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // NS, nanosec=stamp_ns % NS)
        seq = {} if cdr else {"seq": 0}
        transform = types["geometry_msgs/msg/Transform"](
            translation=types["geometry_msgs/msg/Vector3"](*translation),
            rotation=types["geometry_msgs/msg/Quaternion"](*rotation),
        )
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id=parent, **seq)
        made.append(
            types["geometry_msgs/msg/TransformStamped"](
                header=header, child_frame_id=child, transform=transform
            )
        )
    message = types[KIND](transforms=made)
    return bytes((store.serialize_cdr if cdr else store.serialize_ros1)(message, KIND))
