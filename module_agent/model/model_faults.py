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
# What is expected, by pydantic's name of the fault; {} are values of its context.
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
    "string_too_short": "a text of at least {min_length} characters",
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
    "union_tag_invalid": "a {discriminator} of {expected_tags}",
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than": "less than {lt:g}",
    "less_than_equal": "at most {le:g}",
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
    return [(tuple(one["loc"]), _reason(one)) for one in error.errors(include_url=False)]


def first_fault(error: "ValidationError") -> str:
    """Return the first fault as `described`."""
    return described(error.errors(include_url=False)[0])


def described(fault: "ErrorDetails") -> str:
    """Return a fault as `place: reason`, or its reason alone if it is of the whole."""
    place = ".".join(map(str, fault["loc"]))
    return f"{place}: {_reason(fault)}" if place else _reason(fault)


def _reason(fault: "ErrorDetails") -> str:
    kind, context = fault["type"], fault.get("ctx", {})
    if kind in _WHOLE:
        return _WHOLE[kind].format(**context)
    if kind in _EXPECTED:
        return f"expected {_EXPECTED[kind].format(**context)}, found {_shown(fault['input'])}"
    return str(fault["msg"]).removeprefix("Value error, ")


def _shown(value: object) -> str:
    """Return a value as text: bytes may be a secret, and what is large says nothing."""
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list | tuple):
        return f"{len(value)} entries"
    if isinstance(value, str) and len(value) > MAX_SHOWN:
        return f"{value[:MAX_SHOWN]!r} ..."
    return repr(value)
