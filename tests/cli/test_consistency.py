"""The verb consistency."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from amberbox.cli.main import main
from tools.findings import ROOT

POLYBOX = """\
kind: components
types:
  multiplier:
    ports: {left: int, right: int, out: int}
    modes: {ok: {nominal: true, constraints: ["out == left * right"]}, broken: {probability: 0.01}}
  adder:
    ports: {left: int, right: int, out: int}
    modes: {ok: {nominal: true, constraints: ["out == left + right"]}, broken: {probability: 0.01}}
components: {M1: multiplier, M2: multiplier, M3: multiplier, A1: adder, A2: adder}
connections:
  - [M1.right, M3.left]
  - [M1.out, A1.left]
  - [M2.out, A1.right, A2.left]
  - [M3.out, A2.right]
steps:
  - observe: {M1.left: 3, M2.left: 2, M1.right: 2, M2.right: 3, M3.right: 3, A1.out: 10, A2.out: 12}
"""
POWER = """\
kind: components
types:
  breaker:
    ports: {in: [on, off], out: [on, off]}
    modes:
      closed: {nominal: true, constraints: ["out == in"]}
      tripped: {probability: 0.001, constraints: ["out == off"]}
      unknown: {probability: 1e-6}
components: {b1: breaker, b2: breaker}
connections: [[b1.out, b2.in]]
steps:
  - observe: {b1.in: on, b2.out: off}
"""
CIRCUIT = """\
INPUT(a)
INPUT(b)
OUTPUT(out)
inner = NAND(a, b)
out = NOT(inner)
"""


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "power.yaml"
    path.write_text(POWER)
    return path


def test_diagnoses_and_conflicts(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["consistency", str(model), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "model": str(model),
        "conflicts": [["b1", "b2"]],
        "diagnoses": [["b1=tripped"], ["b1=unknown"], ["b2=tripped"], ["b2=unknown"]],
        "ranks": [3, 6, 3, 6], "rank": 3, "count": 4, "time_variants": None, "incomplete": "",
    }  # fmt: skip
    assert main(["consistency", str(model), "--minimal", "rank"]) == 0
    assert "b1=tripped  (rank 3)\n  b2=tripped  (rank 3)\n" in capsys.readouterr().out
    # A voltage behind the first breaker leaves the second one; one before it leaves no fault.
    assert main(["consistency", str(model), "--observe", "b1.out=on", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["conflicts"] == [["b2"]]
    assert main(["consistency", str(model), "--observe", "b1.in=off"]) == 0
    assert capsys.readouterr().out.startswith("no fault")


def test_what_no_modes_explain(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model.write_text(POWER.replace("      unknown: {probability: 1e-6}\n", ""))
    seen = ["--observe", "b1.in=off", "b2.out=on"]
    assert main(["consistency", str(model), *seen]) == 0
    assert "no modes agree" in capsys.readouterr().out
    assert main(["consistency", str(model), *seen, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["diagnoses"], found["conflicts"], found["rank"]) == ([], [[]], None)


def test_ports_that_are_connected_by_way_of_others(
    model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = POWER.replace("b2: breaker", "b2: breaker, b3: breaker")
    model.write_text(text.replace("b2.in]]", "b2.in], [b3.in, b1.out]]"))
    assert main(["consistency", str(model), "--observe", "b2.in=on", "b3.in=off"]) == 0
    assert "no modes agree" in capsys.readouterr().out


def test_a_circuit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "and.bench"
    path.write_text(CIRCUIT)
    seen = ["--observe", "a=1", "b=1", "--observe", "out=0"]
    assert main(["consistency", str(path), *seen, "--minimal", "cardinality", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["diagnoses"] == [["inner"], ["out"]]
    assert (found["conflicts"], found["rank"], found["count"]) == ([["inner", "out"]], 1, 2)
    for wrong, said in {
        "iner=1": "there is no signal 'iner'; did you mean 'inner'?", "a=on": "a is 0 or 1",
    }.items():  # fmt: skip
        assert main(["consistency", str(path), "--observe", wrong]) == 2
        assert said in capsys.readouterr().err


def test_a_search_that_is_ended_says_so(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["consistency", str(model), "--most", "2", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert (found["count"], found["incomplete"]) == (2, "there are more than 2 diagnoses")
    assert main(["consistency", str(model), "--seconds", "0"]) == 1
    assert "incomplete: time was up after 0 diagnoses" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"out == in"', '"out == inn"', "power.yaml:6: types.breaker.modes.closed: 'out == inn': "
         "there is no port and no value 'inn'; did you mean 'in'?"),
        ('"out == in"', '"out == 3"', "cannot compare a number with text"),
        ('"out == in"', '"out + "', "types.breaker.modes.closed.constraints"),
        ('"out == in"', '"mean(out over 5s) == 1"', "looks back in time"),
        ('"out == in"', '"out"', "is no condition"),
        ("nominal: true, ", "", "power.yaml:3: types.breaker: no mode is nominal"),
        ("nominal: true, ", "nominal: true, probability: 0.1, ", "has no probability"),
        ("1e-6", "2", "power.yaml:8: types.breaker.modes.unknown.probability: is not between"),
        ("b2: breaker", "b2: braker", "power.yaml:9: components.b2: there is no type 'braker'; "
         "did you mean 'breaker'?"),
        ("b2.in]", "b2.inn]", "power.yaml:10: connections[0]: there is no port 'b2.inn'; did you "
         "mean 'b2.in'?"),
        ("[b1.out, b2.in]", "[b1.out]", "connects fewer than two"),
        ("b2.out: off", "b2.out: of", "power.yaml:12: steps[0].observe.b2.out: there is no value "
         "'of'; did you mean 'off'?"),
        ("b2.out: off", "b3.out: off", "12: steps[0].observe: there is no port 'b3.out'"),
        ("out: [on, off]}", "out: [on, on]}", "types.breaker.ports.out: has a value twice"),
        ("out: [on, off]}", "out: []}", "types.breaker.ports.out: has no values, or more"),
        ("out: [on, off]}", "out: int}", "has both int ports and ports with listed values"),
        ("out: [on, off]}", "out: [on, off, low]}", "b1.out and b2.in have different values"),
        ("out: [on, off]}", "out: int2}", "types.breaker.ports.out"),
        ("out: [on, off]}", "o.ut: [on, off]}", "has letters, digits and _ only"),
        ("b1: breaker,", "b=1: breaker,", "components.b=1: is no name"),
        ("      tripped:", "      a=b:", "'a=b' is no name"),
        ("components: {", "initial: {b1: close}\ncomponents: {",
         "9: initial.b1: there is no mode 'close'; did you mean 'closed'?"),
        ("components: {", "initial: {b3: closed}\ncomponents: {", "there is no component 'b3'"),
        ("components: {", "history: -1\ncomponents: {", "history: is not between 0 and 1,000"),
        ("components: {", "candidates: 0\ncomponents: {", "candidates: is not between 1 and 1,000"),
        ("  - observe", "  - commands: {b1.cmd: on}\n    observe",
         "12: steps[0].commands: there is no port 'b1.cmd'"),
        ("components: {", "observe: {b1.out: volts > 3}\ncomponents: {",
         "observe.b1.out: 'volts' is no variable of the record: item.variable"),
        ("components: {", "observe: {b1.ou: i.volts}\ncomponents: {", "did you mean 'b1.out'?"),
        ("components: {", "maps_to: {b1=trip: [b1#worn]}\ncomponents: {",
         "maps_to: there is no component and no fault 'b1=trip'; did you mean 'b1=tripped'?"),
        ("components: {", "component: {", "did you mean 'components'?"),
        ("kind: components", "kind: equations", "kind"),
        ("kind: components", "[", "power.yaml:"),
        (POWER, "", "power.yaml:1: file: the key 'kind' is missing"),
    ],
)  # fmt: skip
def test_mistakes_are_said_by_their_place(
    model: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, said: str
) -> None:
    assert POWER.count(old)
    model.write_text(POWER.replace(old, new))
    assert main(["consistency", str(model)]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("left * right", "left" + "+1000000" * 100, "is longer than 600 characters"),
        ("left * right", "left % right", "has int ports and more than whole numbers, + - * and =="),
        ("left * right", "left * 0.5", "has int ports and more than whole numbers"),
        ("out == left *", "out < left *", "has int ports and is no equality"),
        ("M1.left: 3", "M1.left: three", "steps[0].observe.M1.left: 'three' is no whole number"),
    ],
)
def test_mistakes_with_integers(
    model: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, said: str
) -> None:
    model.write_text(POLYBOX.replace(old, new))
    assert main(["consistency", str(model)]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("b1.out", "'b1.out' is not NAME=VALUE"),
        ("b1.ou=on", "there is no port 'b1.ou'; did you mean 'b1.out'?"),
        ("b1.out=onn", "b1.out has no value 'onn'; did you mean 'on'?"),
    ],
)
def test_options_that_do_not_fit(
    model: Path, capsys: pytest.CaptureFixture[str], entry: str, said: str
) -> None:
    assert main(["consistency", str(model), "--observe", entry]) == 2
    assert said in capsys.readouterr().err
    model.write_text(POLYBOX)
    assert main(["consistency", str(model), "--observe", "M1.out=six"]) == 2
    assert "M1.out is a whole number, not 'six'" in capsys.readouterr().err
    assert main(["consistency", str(model), "--most", "0"]) == 2


def test_models_that_are_too_large(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    many = ", ".join(f"v{number}" for number in range(100))
    ports = f"{{in: [{many}], out: [{many}], more: [{many}]}}"
    model.write_text(f"""\
kind: components
types:
  it:
    ports: {ports}
    modes: {{ok: {{nominal: true, constraints: ["in == out or out == more"]}}}}
components: {{it: it}}
""")
    assert main(["consistency", str(model)]) == 2
    assert "its ports have 1,000,000 combinations of values" in capsys.readouterr().err
    names = ", ".join(f"it{number}: it" for number in range(150))
    text = model.read_text().replace("in == out or out == more", "in == v1")
    model.write_text(text.replace("{it: it}", f"{{{names}}}"))
    assert main(["consistency", str(model)]) == 2
    assert "the model is too large" in capsys.readouterr().err
    modes = ", ".join(f"m{number}: {{nominal: true}}" for number in range(101))
    model.write_text(f"""\
kind: components
types:
  it: {{ports: {{}}, modes: {{{modes}}}}}
components: {{it: it}}
""")
    assert main(["consistency", str(model)]) == 2
    assert "power.yaml:3: types.it: has more than 100 modes" in capsys.readouterr().err


TIMED = POWER.replace("    modes:", """\
    transitions:
      - {from: closed, to: open, when: "cmd == off"}
      - {from: [open, tripped], to: closed, when: "cmd == on"}
    modes:
      open: {nominal: true, constraints: ["out == off"]}""").replace("steps:", """\
initial: {b1: open, b2: closed}
steps:
  - {commands: {b1.cmd: on}, observe: {b1.in: on, b2.out: on}}""")  # fmt: skip


def test_a_model_over_time(model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model.write_text(TIMED)
    assert main(["consistency", str(model), "--times", "--reach", "b2.out=on", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["diagnoses"] == [["b1=tripped"], ["b1=unknown"], ["b2=tripped"], ["b2=unknown"]]
    assert found["time_variants"] == 6
    assert [one["variants"] for one in found["times"]] == [1, 2, 1, 2]
    assert found["times"][1] == {
        "variants": 2, "earliest": {"b1=unknown": 1}, "latest": {"b1=unknown": 2}
    }  # fmt: skip
    assert found["plan"] == [{"b1.cmd": "on"}]
    assert sum(found["probabilities"]) == pytest.approx(1)
    assert (found["steps_forgotten"], found["pruned"]) == (0, 0.0)
    # Whichever of both has tripped, closing both is right; where one may do anything, nothing is.
    safe = ["--reach", "b2.out=on", "--safe"]
    assert main(["consistency", str(model), "--minimal", "rank", *safe]) == 0
    assert "each of the diagnoses:\n  1. b1.cmd=on, b2.cmd=on\n" in capsys.readouterr().out
    assert main(["consistency", str(model), *safe]) == 1
    assert "plans that may reach the goal is certain to" in capsys.readouterr().err
    assert main(["consistency", str(model), "--reach", "b1=open", "--minimal", "rank"]) == 0
    assert "  1. b1.cmd=on\n  2. b1.cmd=off\n" in capsys.readouterr().out
    # What was observed is that of the last step.
    assert main(["consistency", str(model), "--observe", "b2.out=on"]) == 0
    assert capsys.readouterr().out.startswith("no fault")


def test_a_long_sequence_forgets_its_beginning(
    model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    steps = "  - {observe: {b1.in: on, b2.out: off}}\n" * 30
    model.write_text(TIMED + steps)
    assert main(["consistency", str(model), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["diagnoses"] == [["b1=tripped"], ["b1=unknown"], ["b2=tripped"], ["b2=unknown"]]
    assert (found["steps_forgotten"], found["pruned"]) == (20, 0.0)
    model.write_text(TIMED + steps + "candidates: 2\n")
    assert main(["consistency", str(model)]) == 0
    assert "20 steps 2 states are remembered; at least 0.0005 of" in capsys.readouterr().out
    model.write_text(TIMED + steps + "history: 0\n")
    assert main(["consistency", str(model), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["steps_forgotten"] == 0


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("from: closed", "from: close", "transitions[0]: there is no mode 'close'; did you mean"),
        ('"cmd == off"', '"inn == off"', "steps[0].commands: there is no port 'b1.cmd'"),
        ('"cmd == off"', '"out + "', "types.breaker.transitions[0].when"),
        ('"cmd == off"', '"in"', "types.breaker.transitions[0].when: 'in': is no condition"),
        ("b1.cmd: on", "b1.cmd: onn", "there is no value 'onn'; did you mean 'on'?"),
    ],
)
def test_mistakes_over_time(
    model: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, said: str
) -> None:
    assert TIMED.count(old)
    text = TIMED.replace(old, new)
    model.write_text(text.replace("cmd == on", "inn == on") if "inn" in new else text)
    assert main(["consistency", str(model)]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--reach", "b1"], "'b1' is not NAME=VALUE"),
        (["--reach", "b1=close"], "b1 has no mode 'close'; did you mean 'closed'?"),
        (["--reach", "b3=closed"], "there is no component and no port 'b3'"),
        (["--reach", "b1.out=onn"], "b1.out has no value 'onn'; did you mean 'on'?"),
        (["--safe"], "--safe is about the commands for --reach"),
        (["--at", "now"], "is not evaluated over a record: --at means nothing"),
        (["drive"], "is a file: NAME and --folder are for a record"),
    ],
)
def test_options_over_time(
    model: Path, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    model.write_text(TIMED)
    assert main(["consistency", str(model), *options]) == 2
    assert said in capsys.readouterr().err
    model.write_text(POWER)
    assert main(["consistency", str(model), "--times"]) == 2
    assert "modes do not change in this model" in capsys.readouterr().err


def test_the_page_shows_what_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (ROOT / "docs" / "robot" / "consistency.md").read_text()
    monkeypatch.chdir(tmp_path)
    for number in (1, 2):
        example = page.split("```yaml\n")[number].split("```")[0]
        Path("power.yaml").write_text(example)
        shown = page.split("```\n$ amberbox ")[number].split("```")[0].split("$ amberbox ")
        assert len(shown) == 2
        for part in shown:
            command, _, printed = part.partition("\n")
            assert main(command.split()) == 0
            assert capsys.readouterr().out == printed
