"""Reports of a diagnosis: its explanation as text, graph, SVG and JSON."""
