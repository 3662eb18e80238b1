"""The link of robot and server: one protocol, the rules of both ends, the robot's client."""
