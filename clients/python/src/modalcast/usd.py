"""Writes the motion of a scene as OpenUSD. Needs `pip install usd-core`.

```python
with scene.vertex_sets(["positions"], count=48) as vertex_sets, UsdWriter(scene, "tree.usdc") as writer:
    for vertex_set in vertex_sets:
        writer.add(vertex_set)
```
"""

from __future__ import annotations

import importlib
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from modalcast._types import F32
from modalcast.vertices import VertexSet

if TYPE_CHECKING:
    from modalcast._sync.scene import Scene


class UsdWriter:
    """Writes one mesh per domain, with one sample of its points per step. A context manager.

    The stage has the unit and the up axis of the scene. Points are in scene units relative to the scene's origin. The
    mesh of a domain has its vertices, without the normals and the textures of its corners, and the diffuse color of its
    first material.
    """

    def __init__(self, scene: Scene, path: str | Path, *, frames_per_second: float = 24.0) -> None:
        """Creates the stage and describes the domains.

        Args:
            scene: The scene.
            path: The file: .usd, .usda or .usdc.
            frames_per_second: Time codes per second: a step at the time t has the time code t * frames_per_second.

        Raises:
            ValueError: The up axis of the scene is "x", or the rate is not positive.
            ModuleNotFoundError: usd-core is not installed.
            Error: The scene could not be described.
        """
        if scene.info.up not in ("y", "z"):
            raise ValueError(f"scene: expected the up axis 'y' or 'z', which USD has, got '{scene.info.up}'")
        if not frames_per_second > 0:
            raise ValueError(f"frames_per_second: expected a number above 0, got {frames_per_second}")
        self._pxr = _pxr_modules()
        self._rate = frames_per_second
        self._origin = np.array(scene.info.origin)
        self._unit = scene.info.unit
        self._times: list[float] = []
        geom = self._pxr.UsdGeom
        stage = self._pxr.Usd.Stage.CreateNew(str(path))
        geom.SetStageUpAxis(stage, scene.info.up.upper())
        geom.SetStageMetersPerUnit(stage, scene.info.unit)
        stage.SetTimeCodesPerSecond(frames_per_second)
        stage.SetFramesPerSecond(frames_per_second)
        stage.SetDefaultPrim(geom.Xform.Define(stage, "/scene").GetPrim())
        self._stage = stage
        self._points = self._define_meshes(scene)

    def add(self, vertex_set: VertexSet) -> None:
        """Adds a sample of the points of all selected domains, at the time of the step.

        Raises:
            ValueError: The positions were not selected, or the step is not later than the step before it.
        """
        if self._times and not vertex_set.step.time > self._times[-1]:
            raise ValueError(f"step.time: expected a time after {self._times[-1]} s, got {vertex_set.step.time} s")
        self._times.append(vertex_set.step.time)
        # The positions of distant domains are relative to origins of their own.
        offsets = (vertex_set.origins - self._origin) / self._unit
        offsets = np.broadcast_to(offsets, (len(vertex_set.domains), 3))
        for domain, offset in zip(vertex_set.domains, offsets, strict=True):
            points = (vertex_set.positions_of(domain) + offset).astype(np.float32)
            attribute = self._points[domain]
            attribute.Set(self._vectors(points), vertex_set.step.time * self._rate)

    def close(self) -> None:
        """Writes the file."""
        if self._times:
            self._stage.SetStartTimeCode(self._times[0] * self._rate)
            self._stage.SetEndTimeCode(self._times[-1] * self._rate)
        self._stage.GetRootLayer().Save()

    def __enter__(self) -> UsdWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _define_meshes(self, scene: Scene) -> list[Any]:
        """Defines the meshes without points. Returns the attribute for the points of each domain."""
        geom, int_array = self._pxr.UsdGeom, self._pxr.Vt.IntArray
        description = scene.describe(["indices", "corner_vertices"])
        names: set[str] = set()
        attributes: list[Any] = []
        for domain in description.domains:
            shape = description.shape_of(domain)
            name = self._pxr.Tf.MakeValidIdentifier(domain.name)
            name = name if name not in names else f"{name}_{domain.index}"
            names.add(name)
            mesh = geom.Mesh.Define(self._stage, f"/scene/{name}")
            faces = shape.faces.astype(np.int32)
            mesh.CreateFaceVertexCountsAttr(int_array.FromNumpy(np.full(len(faces), 3, np.int32)))
            mesh.CreateFaceVertexIndicesAttr(int_array.FromNumpy(faces.reshape(-1)))
            mesh.CreateSubdivisionSchemeAttr(geom.Tokens.none)
            material = description.materials[domain.material]
            mesh.CreateDoubleSidedAttr(material.double_sided)
            mesh.CreateDisplayColorAttr(self._vectors(np.array([material.diffuse], np.float32)))
            attributes.append(mesh.CreatePointsAttr())
        return attributes

    def _vectors(self, rows: F32) -> Any:
        return self._pxr.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(rows))


def _pxr_modules() -> Any:
    """The modules of usd-core, which have no complete type annotations."""
    return SimpleNamespace(**{name: importlib.import_module(f"pxr.{name}") for name in ("Tf", "Usd", "UsdGeom", "Vt")})
