"""What robots know, asked from outside: diagnoses, rules, fault trees, failure modes."""
