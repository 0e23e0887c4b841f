"""The coordinator's clock: an argument, so that the same code runs in real and in virtual time."""

from collections.abc import Callable

Clock = Callable[[], int]
"""Returns session time in integer nanoseconds; it never goes back."""
