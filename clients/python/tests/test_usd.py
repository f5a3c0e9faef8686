"""Stages that `UsdWriter` writes, read with usd-core."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import beam

import modalcast as mc
from modalcast.usd import UsdWriter

Usd: Any = pytest.importorskip("pxr.Usd")
UsdGeom: Any = pytest.importorskip("pxr.UsdGeom")


def points_of(stage: Any, path: str, time_code: float) -> np.ndarray:
    return np.array(UsdGeom.Mesh(stage.GetPrimAtPath(path)).GetPointsAttr().Get(time_code))


def test_points_of_each_step_equal_the_vertices(beams: mc.Scene, tmp_path: Path):
    expected: list[np.ndarray] = []
    path = tmp_path / "beams.usdc"
    with UsdWriter(beams, path, frames_per_second=10) as writer, beams.drive(dt=0.5) as drive:
        for amplitude in (0.0, 0.3, -0.3):
            step = drive.step(np.full(beams.coordinate_count, amplitude))
            writer.add(beams.vertex_set(["positions"], step=step))
            expected.append(beams.vertices())
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == beams.info.up.upper()
    assert UsdGeom.GetStageMetersPerUnit(stage) == beams.info.unit
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 10)
    meshes = [prim.GetPath().pathString for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    assert len(meshes) == 2
    for number, vertices in enumerate(expected):
        points = np.concatenate([points_of(stage, mesh, 5 * number) for mesh in meshes])
        np.testing.assert_allclose(points, vertices, atol=1e-6)
    assert np.abs(expected[1] - expected[2]).max() > 0.01
    faces = np.array(UsdGeom.Mesh(stage.GetPrimAtPath(meshes[0])).GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    np.testing.assert_array_equal(faces, beam()[1])


def test_invalid_arguments_are_rejected(beams: mc.Scene, tmp_path: Path):
    with pytest.raises(ValueError, match="frames_per_second: expected a number above 0, got 0"):
        UsdWriter(beams, tmp_path / "rate.usda", frames_per_second=0)
    with UsdWriter(beams, tmp_path / "time.usda") as writer:
        vertices = beams.vertex_set(["positions"])
        writer.add(vertices)
        with pytest.raises(ValueError, match="expected a time after"):
            writer.add(vertices)
