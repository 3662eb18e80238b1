"""Which sets of failure modes explain the symptoms, from likely to unlikely, and what to test."""
