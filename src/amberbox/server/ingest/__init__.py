"""The server's end of the link: verifies, stores and acknowledges what robots send.

Each row, journal and configuration folder is stored once.
"""
