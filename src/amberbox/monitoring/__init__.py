"""Monitoring: from recorded values to the state of each component, by configured modes."""
