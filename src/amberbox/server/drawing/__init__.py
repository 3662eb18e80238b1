"""Diagrams as SVG: dependency graphs, fault trees, effect graphs, timelines and small charts."""
