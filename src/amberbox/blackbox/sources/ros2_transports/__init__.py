"""ROS 2 on the wire: one file per way to it, and what they share."""

from __future__ import annotations
