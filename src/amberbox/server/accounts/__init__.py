"""Authentication of people, robots and programs.

Passwords, sessions, API tokens, robot keys, and permissions.
"""
