"""What runs in every module: firmware, its published interface, and its local estimates.

`decode_feedback` reads a published feedback message. It is imported when it is first used, so that importing
this package costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from module_agent.wire.feedback_rows import FeedbackRows, decode_feedback

__all__ = ["FeedbackRows", "decode_feedback"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("module_agent.wire.feedback_rows"), name)
