"""Equations between variables of a robot: their structure, and residuals computed from them."""
