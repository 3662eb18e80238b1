"""A diagnosis in words and as a graph: what is broken, how sure, why, and what to do next."""

from amberbox.diagnosis.explanation.explain import explain
from amberbox.diagnosis.explanation.explanation import Explanation
from amberbox.diagnosis.explanation.svg import as_svg
from amberbox.diagnosis.explanation.text import as_text

__all__ = ["Explanation", "as_svg", "as_text", "explain"]
