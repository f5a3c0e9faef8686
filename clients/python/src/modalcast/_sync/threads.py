"""Calls that block, in this thread."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

ResultT = TypeVar("ResultT")


def run_cancelable(work: Callable[[], ResultT], cancel: Callable[[], object]) -> ResultT:  # noqa: ARG001
    """The result of `work`, which an exception in this thread ends, such as KeyboardInterrupt."""
    return work()
