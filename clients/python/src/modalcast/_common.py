"""Step identifiers, deliveries and stage times, which most replies share."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from modalcast.v1 import common_pb2

Delivery: TypeAlias = Literal["latest", "lossless"]
"""Which steps a stream has: the newest ones ("latest"), or every step in order ("lossless")."""

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
