"""The robot folder: what to record, where to, and what is wrong with the files that say so."""
