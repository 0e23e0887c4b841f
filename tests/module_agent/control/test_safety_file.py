"""Limits of modules go into files and come out as they were; what is wrong is answered with line and key."""

import math
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from module_agent.control.gains import catalogue_limits
from module_agent.control.safety import UNCONFIGURED, Safety
from module_agent.control.safety_file import SafetyFileError, read_safety, safety_toml, safety_xml
from module_agent.model.catalogue import CATALOGUE
from module_agent.model.errors import UsageError

INF = math.inf
SERIALS = ("A", "B", "C", "D")
# The manufacturer's own example, with its short words.
EXAMPLE = """<?xml version="1.0" encoding="UTF-8"?>
<group_safety version="1.0.0">
  <mstop>
    <strategy>off hold disabled off</strategy>
  </mstop>
  <position>
    <limit_strategy>hold off disabled spring</limit_strategy>
    <min_limit>-1.5 0 -inf -inf</min_limit>
    <max_limit>1.5 1 inf inf</max_limit>
  </position>
  <velocity>
    <min_limit>-1 -1 -1 -1</min_limit>
    <max_limit>1 1 1 1</max_limit>
  </velocity>
  <effort>
    <min_limit>-1 -1 -1 -1</min_limit>
    <max_limit>1 1 1 1</max_limit>
  </effort>
</group_safety>
"""


def written(tmp_path: Path, text: str, name: str = "limits.toml") -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


def test_toml_gives_every_module_its_table_over_the_default(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        """
[default]
position_rad = [-1.5, 1.5]
velocity_rad_s = 1.0
[module.B]
position_rad = [-inf, 0.5]
at_limit = ["disabled", "spring"]
""",
    )
    limits = read_safety(path, SERIALS)
    assert limits["A"] == Safety(position_rad=(-1.5, 1.5), velocity_rad_s=(-1.0, 1.0))
    assert limits["B"] == Safety(
        position_rad=(-INF, 0.5), at_limit=("disabled", "spring"), velocity_rad_s=(-1.0, 1.0)
    )
    assert limits["C"] == limits["A"]


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("[default]\nspeed = 1.0\n", 2, ("default.speed", "unknown key")),
        ("[default]\nvelocity_rad_s = true\n", 2, ("default.velocity_rad_s",)),
        ("[default]\ncurrent_a = -1.0\n", 2, ("default.current_a", "more than 0")),
        ("[default]\ncurrent_a = nan\n", 2, ("default.current_a",)),
        ("[default]\nwinding_c = 300.0\n", 2, ("default.winding_c", "154")),
        ("[default]\nwinding_c = '90'\n", 2, ("default.winding_c",)),
        ("[module.A]\n\nposition_rad = [0.5, -0.5]\n", 3, ("module.A.position_rad", "0.5 .. -0.5", "below")),
        ("[default]\nposition_rad = [0.0, 1e9]\n", 2, ("default.position_rad", "inf")),
        ("[default]\neffort_nm = [1.0, 2.0]\n", 2, ("default.effort_nm", "1 .. 2")),
        ("[default]\nposition_rad = [0.5, 0.5]\n", 2, ("default.position_rad", "0.5 .. 0.5", "below")),
        ("[default]\neffort_nm = [-1.0, 0.0]\n", 2, ("default.effort_nm", "-1 .. 0", "below 0")),
        ("[default]\neffort_nm = [0.0, 1.0]\n", 2, ("default.effort_nm", "0 .. 1", "below 0")),
        ("[default]\nat_limit = 'brake'\n", 2, ("default.at_limit", "motor_off")),
        ("[default]\nm_stop = 'spring'\n", 2, ("default.m_stop", "motor_off")),
        ("[default]\nbraking_rad_s2 = 0.0\n", 2, ("default.braking_rad_s2",)),
        ("[defaults]\n", 1, ("defaults", "[module.SERIAL]")),
        ("default = 3\n", 1, ("default", "must be a table")),
        ("[module]\nA = 3\n", 2, ("module.A", "must be a table")),
        ("module = 3\n", 1, ("module", "must be a table")),
        ("[module.A]\n[module.E]\n", 1, ("nothing of B, C, D",)),
        ("[default]\n[module.E]\n", 2, ("module.E", "no such module", "A, B, C, D")),
        ("[default]\n[module.E]\nspeed = 1\n", 3, ("module.E.speed",)),
        ("[default\n", 1, ("not TOML",)),
    ],
)
def test_a_mistake_in_toml_is_answered_with_line_and_key(
    tmp_path: Path, text: str, line: int, words: tuple[str, ...]
) -> None:
    path = written(tmp_path, text)
    with pytest.raises(SafetyFileError) as caught:
        read_safety(path, SERIALS, whole_robot=True)
    assert str(caught.value).startswith(f"{path}:{line}: ")
    for word in words:
        assert word in str(caught.value)


def test_a_joint_is_limited_to_a_hundred_thousand_radians_at_most() -> None:
    assert Safety(position_rad=(-1e5, 1e5)).range_rad == (-1e5, 1e5)
    with pytest.raises(ValueError, match="at most 100000, or inf for no limit"):
        Safety(position_rad=(-1e5, math.nextafter(1e5, INF)))


def test_an_agent_takes_a_file_of_the_whole_robot(tmp_path: Path) -> None:
    path = written(tmp_path, "[module.A]\ncurrent_a = 1.0\n[module.E]\ncurrent_a = 2.0\n")
    assert read_safety(path, ("A",)) == {"A": Safety(current_a=1.0)}


def test_the_manufacturers_example_means_what_it_says(tmp_path: Path) -> None:
    limits = read_safety(written(tmp_path, EXAMPLE, "limits.xml"), SERIALS)
    sizes = {"velocity_rad_s": (-1.0, 1.0), "effort_nm": (-1.0, 1.0)}
    assert limits == {
        "A": Safety(position_rad=(-1.5, 1.5), at_limit="hold", m_stop="motor_off", **sizes),
        "B": Safety(position_rad=(0.0, 1.0), at_limit="motor_off", m_stop="hold", **sizes),
        "C": Safety(at_limit="disabled", m_stop="disabled", **sizes),
        "D": Safety(at_limit="spring", m_stop="motor_off", **sizes),
    }


def test_what_is_written_has_the_long_words(tmp_path: Path) -> None:
    limits = read_safety(written(tmp_path, EXAMPLE, "limits.xml"), SERIALS)
    text = safety_xml(list(limits.values()))
    assert "<strategy>motor_off motor_hold disabled motor_off</strategy>" in text
    # A side without a limit has no action.
    assert "<limit_strategy>motor_hold motor_off disabled disabled</limit_strategy>" in text


def test_a_file_for_one_module_is_for_all_that_it_is_given_to(tmp_path: Path) -> None:
    text = "<safety><position><max_limit>0.5</max_limit></position><effort /></safety>"
    limits = read_safety(written(tmp_path, text, "limits.xml"), ("A", "B"))
    assert limits["A"] == limits["B"] == Safety(position_rad=(-INF, 0.5))


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (
            "<group_safety>\n<mstop>\n<strategy>of hold</strategy></mstop></group_safety>",
            3,
            ("'of'", "motor_off"),
        ),
        (
            "<group_safety>\n<position>\n<min_limit>1</min_limit></position></group_safety>",
            3,
            ("1 values for 2",),
        ),
        ("<group_safety><effort>\n<max_limit>1 nan</max_limit></effort></group_safety>", 2, ("nan", "inf")),
        ("<group_safety>\n<torque /></group_safety>", 2, ("group_safety.torque", "unknown element")),
        ("<group_safety><effort>\n<max /></effort></group_safety>", 2, ("effort.max", "min_limit")),
        (
            "<group_safety><effort><max_limit>\n<a/></max_limit></effort></group_safety>",
            2,
            ("nothing is in",),
        ),
        ("<group_safety>\n2 2</group_safety>", 1, ("'2'", "in no element")),
        ("<group_gains />", 1, ("group_gains", "group_safety")),
        ("<group_safety>\n<effort>", 2, ("not XML",)),
        ("<!DOCTYPE a>\n<safety />", 1, ("document type",)),
        (
            "<group_safety><position>\n<min_limit>2 0</min_limit>\n"
            "<max_limit>1 1</max_limit></position></group_safety>",
            3,
            ("position", "module 1 of 2", "2 .. 1"),
        ),
        (
            "<group_safety>\n<velocity>\n<min_limit>0 -1</min_limit></velocity></group_safety>",
            3,
            ("velocity",),
        ),
        (
            "<safety>\n<effort><max_limit>1</max_limit>\n<max_limit>1</max_limit></effort></safety>",
            3,
            ("effort.max_limit", "twice"),
        ),
    ],
)
def test_a_mistake_in_xml_is_answered_with_line_and_element(
    tmp_path: Path, text: str, line: int, words: tuple[str, ...]
) -> None:
    path = written(tmp_path, text, "limits.xml")
    with pytest.raises(SafetyFileError) as caught:
        read_safety(path, ("A", "B"))
    assert str(caught.value).startswith(f"{path}:{line}: ")
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("content", [None, b"\xff\xfe"])
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "limits.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SafetyFileError, match=r"limits\.toml: cannot be read"):
        read_safety(path, SERIALS)


SIZES = st.one_of(st.just(INF), st.floats(1e-3, 1e3))
INTERVALS = st.tuples(SIZES, SIZES).map(lambda pair: (-pair[0], pair[1]))
RANGES = st.tuples(st.floats(-4.0, 0.0), st.floats(0.1, 4.0)) | st.just((-INF, INF)) | st.just((-INF, 0.3))
ACTIONS = st.sampled_from(["disabled", "motor_off", "hold", "spring"])
ANY = st.builds(
    Safety,
    position_rad=RANGES,
    at_limit=st.tuples(ACTIONS, ACTIONS),
    velocity_rad_s=INTERVALS,
    effort_nm=INTERVALS,
    current_a=SIZES,
    winding_c=st.floats(60.0, 154.0),
    braking_rad_s2=st.floats(0.1, 100.0),
    m_stop=st.sampled_from([None, "disabled", "motor_off", "hold"]),
)


@given(st.lists(ANY, min_size=4, max_size=4))
def test_toml_is_read_back_as_it_was_written(safeties: list[Safety]) -> None:
    limits = dict(zip(("A", "B-2", "X-00009", "D"), safeties, strict=True))
    with TemporaryDirectory() as folder:
        assert read_safety(written(Path(folder), safety_toml(limits)), tuple(limits), True) == limits


@given(
    st.lists(
        st.builds(
            Safety,
            position_rad=st.tuples(st.floats(-4.0, 0.0), st.floats(0.1, 4.0)),
            at_limit=ACTIONS,
            velocity_rad_s=INTERVALS,
            effort_nm=INTERVALS,
            m_stop=st.sampled_from(["disabled", "motor_off", "hold"]),
        ),
        min_size=1,
        max_size=4,
    )
)
def test_xml_is_read_back_as_it_was_written(safeties: list[Safety]) -> None:
    with TemporaryDirectory() as folder:
        path = written(Path(folder), safety_xml(safeties), "limits.xml")
        assert list(read_safety(path, SERIALS[: len(safeties)]).values()) == safeties


@pytest.mark.parametrize(
    ("safeties", "words"),
    [
        ([Safety(), Safety(current_a=1.0, winding_c=90.0)], "module 2.*current_a, winding_c"),
        ([Safety(position_rad=(-1.0, 1.0), at_limit=("hold", "spring"))], "module 1 has hold at its lower"),
        ([Safety(m_stop="hold"), Safety()], "module 2 has no m_stop"),
    ],
)
def test_what_xml_cannot_say_is_refused(safeties: list[Safety], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        safety_xml(safeties)


def test_a_side_without_limit_is_written_so() -> None:
    text = safety_xml([Safety(position_rad=(-1.0, 1.0), at_limit=("disabled", "spring"))])
    assert "<min_limit>-inf</min_limit>" in text
    assert "<limit_strategy>spring</limit_strategy>" in text


def test_the_narrower_of_the_types_and_the_owners_limits_holds() -> None:
    snake = catalogue_limits(CATALOGUE["SEA-snake"])
    assert UNCONFIGURED.tightened(snake) == snake
    tight = Safety(position_rad=(-0.5, 3.0), velocity_rad_s=(-0.4, 0.2), effort_nm=(-1.0, 2.0)).tightened(
        snake
    )
    assert (tight.min_position_rad, tight.max_position_rad) == (-0.5, 1.5708)
    assert (tight.max_speed_rad_s, tight.max_effort_nm) == (0.2, 1.0)
    free = Safety(position_rad=(-0.5, 0.5), at_limit="disabled").tightened(
        catalogue_limits(CATALOGUE["X5-9"])
    )
    assert (free.min_position_rad, free.max_position_rad) == (None, None)
    assert Safety(velocity_rad_s=9e9, effort_nm=9e9).tightened(snake) == snake


@pytest.mark.parametrize("effort_nm", [(-1.0, 2.0), (-2.0, 1.0)])
def test_the_effort_that_is_possible_in_both_directions_is_the_smaller_one(
    effort_nm: tuple[float, float],
) -> None:
    assert Safety(effort_nm=effort_nm).tightened(catalogue_limits(CATALOGUE["X5-9"])).max_effort_nm == 1.0


def test_a_range_that_meets_the_types_in_one_point_is_refused() -> None:
    with pytest.raises(UsageError, match="no position is allowed"):
        Safety(position_rad=(1.5708, 3.0)).tightened(catalogue_limits(CATALOGUE["SEA-snake"]))


def test_a_range_outside_of_the_types_is_refused() -> None:
    with pytest.raises(UsageError, match=r"-1\.5708 \.\. 1\.5708"):
        Safety(position_rad=(2.0, 3.0)).tightened(catalogue_limits(CATALOGUE["SEA-snake"]))
