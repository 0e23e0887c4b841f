"""Why data does not fit its pydantic model, in plain words: where, what is expected, and what is there."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    # Programs read their settings before they know that they need more than their help.
    from pydantic import ValidationError
    from pydantic_core import ErrorDetails

Location = tuple[int | str, ...]

# Texts are repeated as far as this.
MAX_SHOWN = 60
# What is expected, by pydantic's name of the fault; {} are values of its context, numbers in full.
_NUMBER, _INTEGER, _TABLE = "a number", "an integer", "a table of keys and values"
_EXPECTED: Mapping[str, str] = {
    "float_type": _NUMBER,
    "float_parsing": _NUMBER,
    "finite_number": "a finite number",
    "int_type": _INTEGER,
    "int_parsing": _INTEGER,
    "int_parsing_size": "an integer of 64 bits",
    "int_from_float": _INTEGER,
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "string_type": "a text",
    "string_too_short": "a text of {min_length} or more characters",
    "string_too_long": "a text of at most {max_length} characters",
    "string_pattern_mismatch": "a text like {pattern}",
    "bytes_type": "bytes",
    "bytes_too_short": "at least {min_length} bytes",
    "bytes_too_long": "at most {max_length} bytes",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": _TABLE,
    "model_type": _TABLE,
    "model_attributes_type": _TABLE,
    "too_short": "{min_length} or more entries",
    "too_long": "at most {max_length} entries",
    "literal_error": "{expected}",
    "enum": "{expected}",
    "union_tag_invalid": "{expected_tags}",
    "greater_than": "more than {gt:.15g}",
    "greater_than_equal": "at least {ge:.15g}",
    "less_than": "less than {lt:.15g}",
    "less_than_equal": "at most {le:.15g}",
}
# Faults of which the value says nothing more, or everything.
_WHOLE: Mapping[str, str] = {
    "extra_forbidden": "unknown key",
    "missing": "is missing",
    "json_invalid": "it is no JSON: {error}",
    "json_type": "it is no JSON",
    "union_tag_not_found": "has no {discriminator}",
}


def faults_of(error: "ValidationError") -> list[tuple[Location, str]]:
    """Return where data does not fit its model, and why."""
    return [(_place(one), _reason(one)) for one in details(error)]


def first_fault(error: "ValidationError") -> str:
    """Return the first fault as `described`."""
    return described(details(error)[0])


def details(error: "ValidationError") -> list["ErrorDetails"]:
    """Return the faults as pydantic has them, without those that follow from others.

    A list whose entries are wrong counts as too short as well: the entries say why.
    """
    faults = error.errors(include_url=False)
    places = [one["loc"] for one in faults]

    def follows(place: Location) -> bool:
        return any(len(other) > len(place) and other[: len(place)] == place for other in places)

    return [one for one in faults if one["type"] != "too_short" or not follows(one["loc"])]


def described(fault: "ErrorDetails") -> str:
    """Return a fault as `place: reason`, or its reason alone if it is of the whole."""
    place = ".".join(map(str, _place(fault)))
    return f"{place}: {_reason(fault)}" if place else _reason(fault)


def _place(fault: "ErrorDetails") -> Location:
    """Return where a fault is: of a table that is none of those expected, the key that says which it is."""
    if fault["type"] == "union_tag_invalid":
        return (*fault["loc"], str(fault["ctx"]["discriminator"]).strip("'"))
    return fault["loc"]


def _reason(fault: "ErrorDetails") -> str:
    kind, context = fault["type"], fault.get("ctx", {})
    if kind in _WHOLE:
        return _WHOLE[kind].format(**context)
    if kind in _EXPECTED:
        return f"expected {_EXPECTED[kind].format(**context)}, found {_found(fault)}"
    return str(fault["msg"]).removeprefix("Value error, ")


def _found(fault: "ErrorDetails") -> str:
    """Return what is there as text. What is or should be bytes may be a secret, and is not repeated."""
    kind, value, context = fault["type"], fault["input"], fault.get("ctx", {})
    if kind == "union_tag_invalid":
        return repr(context["tag"])
    if kind in ("too_short", "too_long"):
        length = context["actual_length"]
        return "more" if length is None else str(length)
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if kind == "bytes_type":
        return f"another type ({type(value).__name__})"
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    if isinstance(value, str) and len(value) > MAX_SHOWN:
        return f"{value[:MAX_SHOWN]!r} ..."
    return repr(value)
