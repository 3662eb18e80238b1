"""The decomposition of Dulmage and Mendelsohn, by its definition."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from amberbox.core.equations.structure import Structure, bits
from amberbox.diagnosis.structure.decomposition import blocks, matrix_json

UNKNOWNS = 6
models = st.lists(st.integers(0, (1 << UNKNOWNS) - 1), max_size=9)


def model_of(variables: list[int]) -> Structure:
    names = [f"e{number}" for number in range(len(variables))]
    return Structure(names, [f"x{n}" for n in range(UNKNOWNS)], [], variables, [], {})


@given(models)
def test_blocks(variables: list[int]) -> None:
    found = blocks(model_of(variables))
    assert sorted(e for block in found for e in block.equations) == list(range(len(variables)))
    assert sorted(u for block in found for u in block.unknowns) == list(range(UNKNOWNS))
    left_of: set[int] = set()
    for block in found:
        count, unknowns = len(block.equations), len(block.unknowns)
        assert {"under": count < unknowns, "just": count == unknowns, "over": count > unknowns}[
            block.part
        ]
        for equation, unknown in zip(block.equations, block.unknowns, strict=False):
            assert variables[equation] >> unknown & 1, "it does not compute this unknown"
        for equation in block.equations:
            assert not left_of & set(bits(variables[equation])), "it has an unknown further left"
        left_of |= set(block.unknowns)


@given(models)
def test_just_determined_blocks_are_as_small_as_can_be(variables: list[int]) -> None:
    for block in blocks(model_of(variables)):
        if block.part != "just":
            continue
        needs = {
            e: {block.equations[block.unknowns.index(u)] for u in bits(variables[e])
                if u in block.unknowns}
            for e in block.equations
        }  # fmt: skip
        reached = {block.equations[0]}
        for _ in needs:
            reached |= {other for e in reached for other in needs[e]}
        assert reached == set(block.equations)


def test_a_known_case() -> None:
    # x0 alone; x1 and x2 together; x3 checked by two; x4 and x5 by one
    variables = [0b000001, 0b000110, 0b000110, 0b001000, 0b001000, 0b110001]
    found = [(b.part, sorted(b.equations), sorted(b.unknowns)) for b in blocks(model_of(variables))]
    assert found[0] == ("under", [5], [4, 5])
    assert sorted(found[1:3], key=str) == [("just", [0], [0]), ("just", [1, 2], [1, 2])]
    assert found[3] == ("over", [3, 4], [3])
    matrix = matrix_json(model_of(variables))
    assert matrix["equations"][0]["unknowns"] == ["x0", "x4", "x5"]
    assert [one["part"] for one in matrix["unknowns"]] == ["under"] * 2 + ["just"] * 3 + ["over"]
