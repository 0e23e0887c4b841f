"""Gains files go in and come out with the same meaning, by our reading and by hebi-py's."""

from pathlib import Path

import numpy as np
import pytest

from module_agent.control.gains import check_gains, default_gains, for_message
from module_agent.control.gains_file import LOOPS, STRATEGIES, GainsFileError, read_gains, write_gains
from module_agent.hardware import hebi_library
from module_agent.model.catalogue import module_type
from module_agent.model.errors import UsageError
from module_agent.wire.messages import GainSet, PidGains

FACTORY = [default_gains(module_type("X5-9"), 3), default_gains(module_type("X5-4"), 4)]

# In another order than the writer's, partial, with infinite limits and a value for all modules.
DOCUMENTED = """<?xml version="1.0" encoding="UTF-8"?>
<group_gains>
  <effort>
    <kd>0.001</kd>
    <min_output>-inf -1</min_output>
    <max_output>inf\t1</max_output>
  </effort>
  <position>
    <output_lowpass>1 0.5</output_lowpass>
    <kp>
      15
      10.5
    </kp>
    <d_on_error>0 1</d_on_error>
  </position>
  <control_strategy>4 Strategy2</control_strategy>
</group_gains>
"""


def _documented(folder: Path) -> Path:
    path = folder / "documented.xml"
    path.write_text(DOCUMENTED)
    return path


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return _documented(tmp_path)


def test_a_partial_file_changes_what_it_says_and_nothing_else(file: Path) -> None:
    first, second = read_gains(file).applied(FACTORY)
    assert (first.strategy, second.strategy) == (4, 2)
    assert (first.position.kp, second.position.kp) == (15.0, 10.5)
    assert (first.position.d_on_error, second.position.d_on_error) == (False, True)
    assert (first.effort.max_output, second.effort.min_output) == (1e6, -1.0)
    assert first.velocity == FACTORY[0].velocity
    assert (
        second.position.model_copy(update={"kp": FACTORY[1].position.kp, "output_lowpass": 1.0})
        == FACTORY[1].position
    )


def test_what_is_written_is_read_again(file: Path, tmp_path: Path) -> None:
    gains = read_gains(file).applied(FACTORY)
    write_gains(tmp_path / "out.xml", gains)
    assert read_gains(tmp_path / "out.xml").applied(FACTORY) == gains


def test_limits_that_are_none_are_taken_by_a_module_and_stay_none(file: Path, tmp_path: Path) -> None:
    for own in read_gains(file).applied(FACTORY):
        check_gains(own)
    file.write_text(
        "<group_gains>"
        + "".join(
            f"<{loop}><i_clamp>inf</i_clamp><min_output>-inf</min_output><max_output>inf</max_output>"
            f"<min_target>-inf</min_target><max_target>inf</max_target></{loop}>"
            for loop in LOOPS
        )
        + "</group_gains>"
    )
    for own in read_gains(file).applied(FACTORY):
        check_gains(own)
    write_gains(tmp_path / "out.xml", read_gains(file).applied(FACTORY))
    text = (tmp_path / "out.xml").read_text()
    for name, value in (("i_clamp", "inf"), ("min_output", "-inf"), ("max_target", "inf")):
        assert text.count(f"<{name}>{value} {value}</{name}>") == len(LOOPS)


def _arm(folder: Path) -> Path:
    """Return the manufacturer's gains of its seven-joint arm, as its files write them: whole, and with -0."""
    ones, none = "1 1 1 1 1 1 1", "0 0 0 0 0 0 0"
    small = "0.25 0.25 0.25 0.25 0.25 0.25 0.25"
    speeds = "3.434687 1.790422 3.434687 3.434687 9.617128 9.617128 9.617128"
    torques = "25 40 25 25 4 4 4"
    loops = {
        "position": {
            "kp": "50 50 25 25 5 2 2",
            "ki": "50 50 25 25 10 5 5",
            "i_clamp": "5 10 5 5 1 1 1",
            "max_target": "inf inf inf inf inf inf inf",
            "max_output": torques,
        },
        "velocity": {
            "kp": "0.1 0.1 0.1 0.1 0.05 0.03 0.03",
            "feed_forward": ones,
            "i_clamp": small,
            "max_target": speeds,
            "output_lowpass": "0.75 0.5 0.5 0.5 0.75 0.75 0.75",
        },
        "effort": {
            "kp": "0.2 0.3 0.3 0.3 0.25 0.25 0.25",
            "kd": "0.0001 0.0001 0.0001 0.001 0.001 0.001 0.001",
            "feed_forward": ones,
            "i_clamp": small,
            "punch": "-0 -0 -0 -0 -0 -0 -0",
            "max_target": torques,
            "output_lowpass": "0.5 0.5 0.5 0.5 0.9 0.9 0.9",
            "d_on_error": none,
        },
    }
    rest = dict.fromkeys(PidGains.model_fields, none) | dict.fromkeys(
        ("max_output", "target_lowpass", "output_lowpass", "d_on_error"), ones
    )
    lines = ["<control_strategy>4 4 4 4 4 4 4</control_strategy>"]
    for loop, own in loops.items():
        values = rest | own
        for side in ("target", "output"):
            values[f"min_{side}"] = " ".join(f"-{limit}" for limit in values[f"max_{side}"].split())
        lines += [f"<{loop}>", *(f"<{name}>{text}</{name}>" for name, text in values.items()), f"</{loop}>"]
    text = (
        "\n   ".join(('<?xml version="1.0" encoding="utf-8"?>\n<group_gains>', *lines)) + "\n</group_gains>\n"
    )
    path = folder / "arm.xml"
    path.write_text(text)
    return path


def test_the_gains_of_an_arm_of_the_manufacturers_keep_their_meaning(tmp_path: Path) -> None:
    path = _arm(tmp_path)
    gains = read_gains(path).applied([default_gains(module_type("X5-1"), 0)] * 7)
    for own in gains:
        check_gains(own)
    assert [own.position.ki for own in gains] == [50.0, 50.0, 25.0, 25.0, 10.0, 5.0, 5.0]
    write_gains(tmp_path / "out.xml", gains)
    assert read_gains(tmp_path / "out.xml").applied(gains[::-1]) == gains
    try:
        hebi = hebi_library.library()
    except UsageError:
        pytest.skip("hebi-py is not installed")
    theirs, ours = hebi.GroupCommand(7), hebi.GroupCommand(7)
    theirs.read_gains(str(path))
    ours.read_gains(str(tmp_path / "out.xml"))
    np.testing.assert_array_equal(ours.control_strategy, theirs.control_strategy)
    for loop in LOOPS:
        for name in PidGains.model_fields:
            before, after = (getattr(command, f"{loop}_{name}") for command in (theirs, ours))
            assert not np.isnan(before).any()
            np.testing.assert_array_equal(after, before, f"{loop}.{name}")


def test_a_gain_that_is_no_limit_cannot_be_infinite(file: Path) -> None:
    file.write_text("<group_gains><position><kp>inf</kp></position></group_gains>")
    possible = r"kp 1e\+06 of the position loop; possible are -1000 \.\. 1000$"
    with pytest.raises(GainsFileError, match=possible):
        read_gains(file)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "<group_gains><position><kp>1 2 3</kp><kd>1 2</kd></position></group_gains>",
            "<kd> has 2 values for 3 modules",
        ),
        ("<group_gains><position><kp/></position></group_gains>", "<kp> has no value"),
        ("<group_gains><position><kq>1</kq></position></group_gains>", "unknown element <kq> in <position>"),
        ("<group_gains><position><kp>x</kp></position></group_gains>", "position.kp: 'x' is no number"),
        ("<group_gains><position><kp>nan</kp></position></group_gains>", "'nan' is no number"),
        ("<group_gains><torque/></group_gains>", "unknown element <torque>"),
        ("<group_gains><control_strategy>5</control_strategy></group_gains>", "control strategy '5'"),
        (
            "<group_gains><effort><i_clamp>-1</i_clamp></effort></group_gains>",
            "effort.i_clamp: expected at least 0, found -1.0",
        ),
        ("<robot/>", "its root is <robot>"),
        (
            '<!DOCTYPE gains [<!ENTITY k "1">]><gains><position><kp>&k;</kp></position></gains>',
            "a document type has no place in a gains file",
        ),
        ("<group_gains>", "no gains file can be read"),
    ],
)
def test_what_is_wrong_is_named(file: Path, text: str, message: str) -> None:
    file.write_text(text)
    with pytest.raises(GainsFileError) as error:
        read_gains(file)
    assert message in str(error.value)
    assert str(file) in str(error.value)


def test_a_file_for_three_modules_is_refused_by_two(file: Path) -> None:
    file.write_text("<group_gains><position><kp>1 2 3</kp></position></group_gains>")
    with pytest.raises(GainsFileError, match="<kp> has 3 values for 2 modules"):
        read_gains(file).applied(FACTORY)
    with pytest.raises(GainsFileError, match="<kp> has 3 values for 2 modules"):
        read_gains(file, modules=2)


def test_hebi_py_reads_our_files_and_we_read_its(tmp_path: Path) -> None:
    try:
        hebi = hebi_library.library()
    except UsageError:
        pytest.skip("hebi-py is not installed")
    path = tmp_path / "gains.xml"
    write_gains(path, FACTORY)
    command = hebi.GroupCommand(2)
    command.read_gains(str(path))
    for index, gains in enumerate(FACTORY):
        assert command.control_strategy[index] == gains.strategy
        for loop in LOOPS:
            _same(command, index, loop, getattr(gains, loop))
    command.write_gains(str(tmp_path / "theirs.xml"))
    theirs = read_gains(tmp_path / "theirs.xml").applied([_other(one) for one in FACTORY])
    for own, read in zip(FACTORY, theirs, strict=True):
        assert STRATEGIES[read.strategy] == STRATEGIES[own.strategy]
        for loop in LOOPS:
            # hebi-py keeps 32-bit numbers.
            assert getattr(read, loop).model_dump() == pytest.approx(
                getattr(own, loop).model_dump(), rel=1e-6
            )


def _same(command: object, index: int, loop: str, gains: PidGains) -> None:
    for name, value in gains:
        told = for_message(float(getattr(command, f"{loop}_{name}")[index]))
        assert told == pytest.approx(float(value), rel=1e-6), f"{loop}.{name}"


def _other(gains: GainSet) -> GainSet:
    return default_gains(module_type("X5-1"), 0 if gains.strategy else 1)
