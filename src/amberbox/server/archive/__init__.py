"""The archive of recordings.

Journals as files, columns as Delta tables, retention, and a record to query them.
"""
