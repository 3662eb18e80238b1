"""The store, a folder of journals and Parquet segments: locks, manifest, segment building, and
reading it all as one record.
"""
