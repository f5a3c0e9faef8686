"""Calls that block, in another thread."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import TypeVar

from modalcast.errors import Error

ResultT = TypeVar("ResultT")


async def run_cancelable(work: Callable[[], ResultT], cancel: Callable[[], object]) -> ResultT:
    """The result of `work`. If this task is canceled, `cancel` ends `work`, which is awaited."""
    running = asyncio.ensure_future(asyncio.to_thread(work))
    try:
        return await asyncio.shield(running)
    except asyncio.CancelledError:
        cancel()
        with contextlib.suppress(Error):
            await running
        raise
