"""Prolog for rules: a stated subset of ISO Prolog, with tabling, Datalog and proofs."""
