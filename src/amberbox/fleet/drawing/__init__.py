"""Diagrams of the pages: SVG made of plain dataclasses, without anything from outside."""
