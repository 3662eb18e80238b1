"""From symptoms to causes: FMEA, covering, fault trees, rules, explanation. Pure functions."""
