"""A ROS 1 subscriber in pure Python: master, node API and TCPROS, no ROS installed. Used by the
source ``ros`` and by probes.
"""
