"""A subscriber that runs on ROS's own Python and writes its messages to a file.

Usage: listener.py OUT TOPIC... Each line of OUT is a topic, latching or not, and the message.
"""

from __future__ import annotations

import json
import sys
from functools import partial
from typing import Any

import rospy


def heard(topic: str, message: Any) -> None:
    """Write down one message, its bytes as hexadecimal digits."""
    header: dict[str, str] = message._connection_header
    line = {"topic": topic, "latching": header["latching"], "md5": header["md5sum"]}
    OUT.write(json.dumps(line | {"type": header["type"], "data": message._buff.hex()}) + "\n")
    OUT.flush()


OUT = open(sys.argv[1], "w")  # noqa: SIM115, PTH123  # as long as the process lives
rospy.init_node("listener", disable_signals=True)
for name in sys.argv[2:]:
    rospy.Subscriber(name, rospy.AnyMsg, partial(heard, name), queue_size=1000)
rospy.spin()
