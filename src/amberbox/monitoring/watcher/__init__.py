"""The process that watches a record, live or replayed, and writes down what it finds."""
