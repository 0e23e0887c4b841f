"""`result.json` is the complete old or the complete new one, and says everything in its schema."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from coordinator.identification.result import (
    SCHEMA,
    ChainPart,
    ExponentialsPart,
    LinkPart,
    Result,
    write_result,
)
from module_agent.model.chain import Chain


def _chain() -> Chain:
    rng = np.random.default_rng(1)
    return Chain(
        ("A", "B"),
        (-1, 0),
        (False, True),
        np.eye(3)[:2],
        rng.normal(size=(2, 3)),
        rng.normal(size=(2, 4, 4)),
        np.array([0.0, 0.0, 9.81]),
    )


def _result(robot: str = "robot") -> Result:
    return Result(
        robot=robot,
        serials=["A", "B"],
        types={"A": "X5-1", "B": "X5-4"},
        topology_confidence=0.4,
        chain=ChainPart(**_chain().to_dict()),
        rank=4,
        condition=10.0,
        reduced_chi2=1.0,
        unresolved=[],
        null_basis=[[0.0]] * 12,
        chain_covariance=[[0.0] * 12] * 12,
        transforms=[],
        product_of_exponentials=ExponentialsPart(screws=[], tips=[]),
        links=[LinkPart(parent="A", child="B", link_length_mm=171.0, link_length_sigma_mm=0.9)],
        pairs=[],
        denavit_hartenberg=[],
        dynamics=None,
        notes=[],
        robot_time_s=1.0,
        wall_time_s=None,
        trace_hash="0" * 64,
    )


def test_the_chain_survives_the_file_to_the_last_bit(tmp_path: Path) -> None:
    write_result(tmp_path / "result.json", _result())
    found = Result.model_validate_json((tmp_path / "result.json").read_bytes())
    chain = _chain()
    for name in ("axis", "point", "imu_home", "gravity"):
        np.testing.assert_array_equal(getattr(found.chain, name), getattr(chain, name))
    assert (found.chain.serials, found.chain.parent, found.chain.reversed) == (
        ["A", "B"],
        [-1, 0],
        [False, True],
    )


def test_the_file_names_its_schema(tmp_path: Path) -> None:
    write_result(tmp_path / "result.json", _result())
    assert json.loads((tmp_path / "result.json").read_text())["schema"] == SCHEMA


def test_a_crash_while_writing_leaves_the_old_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "result.json"
    write_result(path, _result("old"))
    before = path.read_bytes()

    def crash(*_: object) -> None:
        raise OSError("disk pulled out")

    monkeypatch.setattr(os, "replace", crash)
    with pytest.raises(OSError, match="pulled out"):
        write_result(path, _result("new"))
    assert path.read_bytes() == before


def test_a_result_does_not_take_what_its_schema_lacks() -> None:
    fields = _result().model_dump(by_alias=True)
    with pytest.raises(ValidationError, match="extra"):
        Result.model_validate({**fields, "colour": "red"})


def test_a_result_of_schema_1_is_read() -> None:
    text = (Path(__file__).parent / "data" / "result_schema_1.json").read_text()
    old, result = json.loads(text), Result.model_validate_json(text)
    assert old["schema"] == 1
    assert result.schema_version == SCHEMA
    assert [item.summary for item in result.unresolved] == [item["words"] for item in old["unresolved"]]
    dynamics, before = result.dynamics, old["dynamics"]
    assert dynamics is not None
    assert dynamics.summary == before["words"]
    assert dynamics.motion_source == before["seen_by"]
    assert [p.summary for p in dynamics.base_parameters] == [p["words"] for p in before["base_parameters"]]
    kinds = [(p.identifiability, p.base_parameters) for p in dynamics.identifiability]
    assert kinds == [(p["verdict"], p["sums"]) for p in before["verdicts"]]
    assert [t.significant for t in dynamics.torque_terms] == [t["used"] for t in before["torque_terms"]]
    again = json.loads(result.model_dump_json(by_alias=True))
    assert again["schema"] == SCHEMA
    assert Result.model_validate(again) == result
