"""A ROS 1 subscriber in pure Python: master, node API and TCPROS, no ROS installed."""
