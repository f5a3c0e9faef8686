"""Step identifiers, deliveries and stage times, which most replies share."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from modalcast.v1 import common_pb2

Delivery: TypeAlias = Literal["latest", "lossless"]
"""Which steps a stream has: the newest ones ("latest"), or every step in order ("lossless")."""

MAX_STALL_BUDGET = 86_400.0
"""The largest stall budget of a drive, in seconds: a day."""

_DELIVERIES: dict[str, common_pb2.Delivery] = {
    "latest": common_pb2.DELIVERY_LATEST,
    "lossless": common_pb2.DELIVERY_LOSSLESS,
}


@dataclass(frozen=True, order=True)
class StepId:
    """Identifies a step.

    Attributes:
        run: Number of the writer; later writers have larger numbers. 0 before the first step.
        number: Number of the step; increases within a run.
        time: Simulation time in seconds.
    """

    run: int
    number: int
    time: float


def step_id(message: common_pb2.StepId) -> StepId:
    """Converts from a message."""
    return StepId(message.run, message.number, message.time)


def delivery_message(delivery: str) -> common_pb2.Delivery:
    """Converts to the enum of the contract.

    Raises:
        ValueError: The name is unknown.
    """
    if delivery not in _DELIVERIES:
        raise ValueError(f"delivery: expected 'latest' or 'lossless', got '{delivery}'")
    return _DELIVERIES[delivery]


def stall_budget_milliseconds(seconds: float | None) -> int:
    """The stall budget of a drive in the unit of the contract; 0 for the server's default.

    Raises:
        ValueError: The budget is not above 0, or is above a day.
    """
    if seconds is None:
        return 0
    if not 0 < seconds <= MAX_STALL_BUDGET:
        raise ValueError(f"stall_budget: expected seconds above 0 and at most {MAX_STALL_BUDGET}, got {seconds}")
    return math.ceil(1000 * seconds)


def step_selector(step: StepId | int | None, *, exact: bool) -> common_pb2.StepSelector | None:
    """Selects `step` or, unless `exact`, a later step. None selects the current step."""
    if step is None:
        return None
    run, number = (step.run, step.number) if isinstance(step, StepId) else (0, step)
    if exact:
        return common_pb2.StepSelector(run=run, exact=number)
    return common_pb2.StepSelector(run=run, minimum=number)


def stage_times(stages: Iterable[common_pb2.StageTime]) -> dict[str, float]:
    """Milliseconds by stage; `common.proto` lists the stages."""
    return {stage.stage: stage.milliseconds for stage in stages}
