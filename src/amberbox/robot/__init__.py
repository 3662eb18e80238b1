"""The agent on the robot: keeps everything running that records, monitors and reports."""
