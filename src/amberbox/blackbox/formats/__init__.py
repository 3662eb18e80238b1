"""Readers of recordings made by other tools: ROS 1 and ROS 2 bags, MCAP, ULog, CSV, mongodump."""
