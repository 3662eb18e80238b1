"""The fleet server: receives and archives robots' recordings, raises alarms, serves API and web
pages.
"""
