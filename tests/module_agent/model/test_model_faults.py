"""What does not fit a model is said in words of ours, and says no secret."""

from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core._pydantic_core import list_all_errors

from module_agent.model.model_faults import _EXPECTED, _WHOLE, faults_of, first_fault


class Inner(BaseModel):
    """What is within."""

    kind: Literal["inner"] = "inner"
    size: Annotated[int, Field(ge=1, lt=9)]


class Outer(BaseModel):
    """Another."""

    kind: Literal["outer"]


class Document(BaseModel):
    """One field of every kind."""

    model_config = ConfigDict(extra="forbid", strict=True)

    number: Annotated[float, Field(gt=0.0, le=2.0, allow_inf_nan=False)] = 1.0
    name: Annotated[str, Field(min_length=1, max_length=80, pattern="^[a-z]*$")] = "a"
    secret: Annotated[bytes, Field(max_length=4)] = b""
    flag: bool = False
    inner: Inner | None = None
    items: Annotated[list[int], Field(min_length=1, max_length=3)] = [1]
    pair: tuple[float, float] = (0.0, 0.0)
    shape: Annotated[Inner | Outer, Field(discriminator="kind")] | None = None
    inners: Annotated[tuple[Inner, ...], Field(min_length=1)] = (Inner(size=1),)
    time_ns: Annotated[int, Field(ge=1_000_001, lt=2**32)] = 10**7


@pytest.mark.parametrize(
    ("document", "fault"),
    [
        ({"number": "much"}, "number: expected a number, found 'much'"),
        ({"number": float("nan")}, "number: expected a finite number, found nan"),
        ({"number": 0.0}, "number: expected more than 0, found 0.0"),
        ({"number": 2.5}, "number: expected at most 2, found 2.5"),
        ({"name": 3}, "name: expected a text, found 3"),
        ({"name": ""}, "name: expected a text of 1 or more characters, found ''"),
        ({"name": "A"}, "name: expected a text like ^[a-z]*$, found 'A'"),
        ({"name": "a" * 81}, f"name: expected a text of at most 80 characters, found '{'a' * 60}' ..."),
        ({"flag": "yes"}, "flag: expected true or false, found 'yes'"),
        ({"inner": 3}, "inner: expected a table of keys and values, found 3"),
        ({"inner": {}}, "inner.size: is missing"),
        ({"inner": {"size": 0}}, "inner.size: expected at least 1, found 0"),
        ({"inner": {"size": 9}}, "inner.size: expected less than 9, found 9"),
        ({"inner": {"size": 1.5}}, "inner.size: expected an integer, found 1.5"),
        ({"inner": {"size": 1, "kind": "outer"}}, "inner.kind: expected 'inner', found 'outer'"),
        ({"items": []}, "items: expected 1 or more entries, found 0"),
        ({"items": [1, 2, 3, 4]}, "items: expected at most 3 entries, found 4"),
        ({"items": 1}, "items: expected a list, found 1"),
        ({"pair": {"a": 1}}, "pair: expected a list, found a table"),
        ({"other": 1}, "other: unknown key"),
        ({"inner": [1]}, "inner: expected a table of keys and values, found a list of 1"),
        # The key that says which of several tables it is, and what it says.
        ({"shape": {"kind": "round"}}, "shape.kind: expected 'inner', 'outer', found 'round'"),
        ({"shape": {}}, "shape: has no 'kind'"),
        # Bounds are said in full: 4.29497e+09 would be true of what is refused.
        ({"time_ns": 2**32}, "time_ns: expected less than 4294967296, found 4294967296"),
        ({"time_ns": 10**6}, "time_ns: expected at least 1000001, found 1000000"),
        # Without its only entry, which is wrong, the list would be too short.
        ({"inners": ({"size": 0},)}, "inners.0.size: expected at least 1, found 0"),
    ],
)
def test_a_fault_says_where_what_is_expected_and_what_is_there(document: Any, fault: str) -> None:
    with pytest.raises(ValidationError) as caught:
        Document.model_validate(document)
    assert first_fault(caught.value) == fault
    assert len(faults_of(caught.value)) == 1


@pytest.mark.parametrize("text", ["", "{", "[1"])
def test_what_is_no_json_at_all_has_no_place(text: str) -> None:
    with pytest.raises(ValidationError) as caught:
        Document.model_validate_json(text)
    assert first_fault(caught.value).startswith("it is no JSON: ")


@pytest.mark.parametrize(
    ("secret", "found"),
    [
        (b"abcde", "at most 4 bytes, found 5 bytes"),
        ("hunter2", "bytes, found another type (str)"),
        (4711, "bytes, found another type (int)"),
    ],
)
def test_what_may_be_a_secret_is_not_repeated(secret: Any, found: str) -> None:
    with pytest.raises(ValidationError) as caught:
        Document.model_validate({"secret": secret})
    assert first_fault(caught.value) == f"secret: expected {found}"


def test_every_sentence_has_the_values_that_pydantic_gives() -> None:
    """One that lacked a value would end an agent by the message that it is to refuse."""
    examples = {one["type"]: one["example_context"] or {} for one in list_all_errors()}
    for kind, sentence in (_EXPECTED | _WHOLE).items():
        assert "{" not in sentence.format(**examples[kind])
