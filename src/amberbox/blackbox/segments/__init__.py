"""Segments: the columns of sealed journals as Parquet files, and the manifest that lists them."""
