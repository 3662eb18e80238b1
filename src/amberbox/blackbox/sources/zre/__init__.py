"""ZRE, the protocol of Zyre: beacons, messages, and a node that listens."""
