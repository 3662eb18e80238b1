"""Internals of the expression language: grammar, syntax tree, values, evaluation."""
