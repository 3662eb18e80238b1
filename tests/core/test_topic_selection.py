"""Topics by pattern, exclusion and type: what matches, what wins, what ``check`` notes."""

import re
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.core.source import TopicOptions
from amberbox.core.topic_selection import SelectionOptions, TopicPattern, TopicSelection


@pytest.mark.parametrize(
    ("pattern", "fits", "fits_not"),
    [
        ("/cam/*", ["/cam/a", "/cam/a_b"], ["/cam", "/cam/a/b", "/camera", "/x/cam/a"]),
        ("/cam/**", ["/cam/a", "/cam/a/b/c"], ["/cam", "/camera/a"]),
        ("/**/image", ["/image", "/a/image", "/a/b/image"], ["/a/image/raw", "/a/my_image"]),
        ("/**", ["/a", "/a/b"], ["a"]),
        ("/front*/sc*n", ["/front/scan", "/front_left/scn"], ["/a/front/scan", "/front/scans"]),
        ("/a/**/b/*/c", ["/a/b/x/c", "/a/b/b/x/c", "/a/x/y/b/z/c"], ["/a/b/c", "/a/x/b/c"]),
        ("/**/a/**/b", ["/a/b", "/x/a/y/a/z/b"], ["/b/a", "/a"]),
        ("/a.c", ["/a.c"], ["/abc"]),
    ],
)
def test_a_star_stays_within_a_level_and_two_stand_for_levels(
    pattern: str, fits: list[str], fits_not: list[str]
) -> None:
    found = TopicPattern(pattern)
    assert [name for name in fits + fits_not if found.fits(name)] == fits


@given(
    st.lists(st.sampled_from(["a", "b", "*", "a*", "*b*a", "**"]), min_size=1, max_size=5),
    st.lists(st.sampled_from(["", "a", "b", "ab", "bba", "aab"]), min_size=1, max_size=6),
)
def test_patterns_match_as_their_definition(levels: list[str], names: list[str]) -> None:
    whole = "/".join(levels)
    if levels[-1] == "**":
        levels = [*levels, "*"]
    written = "".join(
        "(?:[^/]*/)*" if level == "**" else level.replace("*", "[^/]*") + "/" for level in levels
    )
    expected = re.fullmatch(written, "/".join(names) + "/") is not None
    assert TopicPattern(whole).fits("/".join(names)) == expected


def test_a_hostile_name_is_matched_without_backtracking() -> None:
    pattern = TopicPattern("/" + "*a" * 20 + "b")
    # a matcher that backtracks takes years for these
    assert not pattern.fits("/" + "a" * 100_000)
    assert not TopicPattern("/**/a/**/a/**/a/b").fits("/a" * 2_000)
    assert not TopicSelection([TopicOptions("/**")]).chooses("/" + "a" * 2_000)


def topics(*names: str) -> list[TopicOptions]:
    return [TopicOptions(name, max_frequency=1.0 + number) for number, name in enumerate(names)]


def rate(selection: TopicSelection, name: str) -> float | None:
    found = selection.options(name)
    assert found is None or found.name == name
    return None if found is None else found.max_frequency


def test_a_name_beats_patterns_and_the_first_pattern_beats_the_others() -> None:
    selection = TopicSelection(topics("/**/image", "/cam/*", "/cam/info"))
    names = ("/cam/info", "/cam/image", "/cam/x", "/x")
    assert [rate(selection, name) for name in names] == [3.0, 1.0, 2.0, None]
    assert [selection.chooses(name) for name in names] == [True, True, True, False]
    assert list(selection.named) == ["/cam/info"]


def test_exclusion_beats_patterns_and_a_name_beats_exclusion() -> None:
    selection = TopicSelection(
        topics("/cam/**", "/cam/a/info"), exclude=["/cam/a/*", "/odom"], all_topics=False
    )
    assert selection.chooses("/cam/a/info")
    assert selection.chooses("/cam/b/x")
    assert not selection.chooses("/cam/a/x")
    everything = TopicSelection((), all_topics=True, exclude=["/odom"], left_out=["/rosout"])
    chosen = [name for name in ("/odom", "/rosout", "/tf") if everything.chooses(name)]
    assert chosen == ["/tf"]


def test_types_choose_among_found_topics_in_the_spelling_of_either_ros() -> None:
    selection = TopicSelection(
        topics("/odom"), all_topics=True, types=["sensor_msgs/*"], exclude_types=["*/Image"]
    )
    assert selection.needs_types
    assert selection.chooses("/odom", "nav_msgs/Odometry")
    assert selection.chooses("/scan", "sensor_msgs/LaserScan")
    assert selection.chooses("/scan", "sensor_msgs/msg/LaserScan")
    assert not selection.chooses("/cam", "sensor_msgs/msg/Image")
    assert not selection.chooses("/tf", "tf2_msgs/TFMessage")
    # not known yet
    assert not selection.chooses("/scan2", "")
    assert not selection.chooses("/scan2", "*")
    ros2 = TopicSelection((), all_topics=True, types=["sensor_msgs/msg/*"])
    assert ros2.chooses("/scan", "sensor_msgs/LaserScan")


@dataclass(frozen=True)
class Options(SelectionOptions):
    @staticmethod
    def is_name(name: str) -> bool:
        return re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", name) is not None


def test_a_namespace_completes_relative_names_and_patterns() -> None:
    options = Options(topics("odom", "/tf", "cam/*"), namespace="robot1", exclude=["cam/raw"])
    assert [topic.name for topic in options.full_topics()] == [
        "/robot1/odom", "/tf", "/robot1/cam/*",
    ]  # fmt: skip
    selection = options.selection()
    assert selection.chooses("/robot1/cam/small")
    assert not selection.chooses("/robot1/cam/raw")
    assert list(options.check()) == []
    assert Options(topics("odom")).full_name("odom") == "/odom"


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (Options(), "names no topic"),
        (Options(topics("/cam**/x")), "** stands for whole levels"),
        (Options(topics("/cam-1/*")), "'/cam-1/*' is not a name ROS allows for a topic"),
        (Options(topics("odom", "/odom")), "'odom' and '/odom' are the same topic"),
        (Options(topics("/odom"), namespace="a b"), "'a b' is not a name ROS allows"),
        (Options(topics("/odom"), exclude=["odom"]), "'odom' is also listed"),
        (Options(all_topics=True, exclude=["/x y"]), "'/x y' is not a name ROS allows"),
        (Options(all_topics=True, types=["Image"]), "write PACKAGE/Image, or '*/Image'"),
        (Options(all_topics=True, exclude_types=["a**/b"]), "** stands for whole levels"),
    ],
)
def test_check_names_what_is_wrong(options: Options, what: str) -> None:
    (problem,) = options.check()
    assert what in problem[1]


@pytest.mark.parametrize(
    ("options", "note"),
    [
        (Options(topics("/cam/*"), exclude=["/cam/**"]), "finds nothing: '/cam/**' excludes all"),
        (Options(topics("/cam/**", "/cam/*/info")), "'/cam/*/info' is not used"),
        (Options(topics("/odom"), exclude=["/cam/**"]), "every topic is listed by its name"),
        (Options(topics("/odom"), types=["nav_msgs/*"]), "every topic is listed by its name"),
    ],
)
def test_what_can_have_no_effect_is_noted(options: Options, note: str) -> None:
    assert list(options.check()) == []
    (found,) = options.notes()
    assert note in found[1]


def test_nothing_is_noted_where_patterns_only_overlap() -> None:
    options = Options(
        topics("/cam/*/info", "/cam/**", "/**/scan"), exclude=["/cam/*", "/cam/raw/**"]
    )
    assert list(options.notes()) == []
