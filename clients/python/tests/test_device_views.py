"""Pictures of views as tensors on the GPU of the server."""

from __future__ import annotations

import gc
import importlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from scenes import RANK, beam

import modalcast as mc

WORLDS = 37
OUTPUTS = ("normals", "depth", "color", "domains")


@pytest.fixture(scope="module")
def torch() -> Any:
    """torch, on a machine with a GPU."""
    pytest.importorskip("torch", reason="needs torch and an NVIDIA GPU")
    module = importlib.import_module("torch")
    if not module.cuda.is_available():
        pytest.skip("needs an NVIDIA GPU")
    return module


@pytest.fixture(scope="module")
def scene(torch: Any) -> Iterator[mc.Scene]:
    """A beam on a server that draws on the GPU."""
    assert torch.cuda.is_available()
    with mc.spawn(arguments=["--backend", "cuda", "--renderer", "off"]) as client:
        yield client.upload(mc.SceneBuilder("device-views").add(*beam()))


def coordinates(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 0.3, (WORLDS, RANK))


# Sizes whose arrays begin at addresses that are no multiples of 16.
@pytest.mark.parametrize("size", [64, (33, 21)])
def test_tensors_equal_arrays(torch: Any, scene: mc.Scene, size: int | tuple[int, int]) -> None:
    with (
        scene.views(worlds=WORLDS, size=size, outputs=OUTPUTS) as host,
        scene.views(worlds=WORLDS, size=size, outputs=OUTPUTS, device="cuda") as device,
    ):
        earlier = host.step(coordinates(0))
        for seed in range(1, 8):
            expected = host.step(coordinates(seed))
            tensors = {name: torch.from_dlpack(array) for name, array in device.step(coordinates(seed)).items()}
            for name in OUTPUTS:
                assert tensors[name].is_cuda
                np.testing.assert_array_equal(tensors[name].cpu().numpy(), expected[name])
                assert (expected[name] != earlier[name]).any(), "control: expected other pictures of another step"
            earlier = expected
            del tensors


def test_slot_is_not_written_while_a_tensor_of_it_exists(torch: Any, scene: mc.Scene) -> None:
    with scene.views(worlds=WORLDS, device="cuda", slots=3) as views:
        kept = torch.from_dlpack(views.step(coordinates(0))["color"])
        copy = kept.clone()
        for seed in range(1, 10):
            views.step(coordinates(seed))
        assert torch.equal(kept, copy)
        others = [torch.from_dlpack(views.step(coordinates(seed))["color"]) for seed in (20, 21)]
        with pytest.raises(
            mc.DeadlineExceeded, match=r"3 in use: 0 by steps in flight, the others by arrays of the steps"
        ):
            views.step(coordinates(22))
        assert not torch.equal(kept, others[0])
        del others
        views.step(coordinates(22))
        assert torch.equal(kept, copy)
    # The tensor is valid without the call.
    gc.collect()
    assert torch.equal(kept, copy)


def test_rejected_step_leaves_its_slot_free(scene: mc.Scene) -> None:
    with scene.views(worlds=WORLDS, device="cuda", slots=2) as views:
        for _ in range(4):
            with pytest.raises(mc.InvalidRequest):
                views.step(np.full((WORLDS, RANK), np.nan))
            views.step(coordinates(1))


def test_array_interface_of_cuda_has_the_same_memory(torch: Any, scene: mc.Scene) -> None:
    with scene.views(worlds=WORLDS, device="cuda") as views:
        array: Any = views.step(coordinates(1))["color"]
        tensor = torch.as_tensor(array, device="cuda")
        assert tensor.data_ptr() == array.address == torch.from_dlpack(array).data_ptr()
        assert tuple(tensor.shape) == array.shape == (WORLDS, 64, 64, 3)
