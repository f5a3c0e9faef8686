"""Modes of a surface or a volume mesh."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from numpy.typing import ArrayLike

from modalcast._async.threads import run_cancelable
from modalcast.modeling import Computation, ModalModel, ModelingProgress, Surface


async def make_model(
    source: Surface,
    *,
    modes: int | None = None,
    large: bool = False,
    material: str | Sequence[str] | None = None,
    clamp: str | Sequence[str] | None = None,
    unit: str | None = None,
    up: str | None = None,
    damping: float | None = None,
    max_frequency: float | None = None,
    freedoms: int | None = None,
    point_masses: ArrayLike | None = None,
    thickness: float | None = None,
    threads: int | None = None,
    progress: bool | ModelingProgress = False,
    out: str | Path | None = None,
    overwrite: bool = False,
    program: str | Path | None = None,
) -> ModalModel:
    """Computes the modes of a part from its surface or a volume mesh by finite elements. Ctrl-C ends the computation.

    Args:
        source: An OBJ, PLY, STL, glTF or npz file; a mesh of tetrahedra (Gmsh .msh, .vtk, .vtu, Vega .veg); the result
            has its surface; or arrays: the vertices, n x 3, and the faces, m x 3 or m x 4.
        modes: Number of elastic modes; None: 20, or 5 if `large`.
        large: For large motion of a volume mesh: adds the derivatives of the modes to U, r = modes (modes + 3) / 2, and
            writes cubic forces beside `out`, as NAME.cub, with which `modalcast-sim` moves the part.
        material: A name such as "steel", or "E=2.1e11,nu=0.3,rho=7850" in Pa and kg/m^3. With several, "GROUP:MATERIAL"
            is for one group or shell. None: that of the file (.veg), else steel.
        clamp: Regions that do not move, such as "z < 0.01", "group NAME" or "near X Y Z RADIUS", in the unit and the
            axes of the source; None: a free part.
        unit: Of the lengths in the source: "m", "mm", "cm", "um", "in" or "ft"; None: meters.
        up: The axis of the source that points up: "x", "y" or "z"; None: that of the file's format; z for arrays.
        damping: Fraction of critical damping; None: that of the material.
        max_frequency: In Hz; there are no modes of higher frequencies.
        freedoms: Limit on the unknowns of the computation, three per node; None: that of the program.
        point_masses: Rows of x, y, z and a mass in kg, k x 4, in the unit and the axes of the source.
        thickness: Of a sheet, for a surface without volume, in the unit of the source.
        threads: Number of threads, on which the result does not depend; None: one per core.
        progress: True: a line on standard error; or a function that is called with the completed fraction, 0 to 1, and
            the name of the stage, in asyncio from another thread.
        out: The .npz file that is written, which the server opens too; None: no file remains.
        overwrite: Whether `out` may exist.
        program: The program `modalcast`; None: that of MODALCAST_PROGRAM, else the one in PATH.

    Raises:
        ModelingError: The program is missing, or rejects the surface or an option; the message says why.
        ValueError: An array has another shape, or `large` is set without `out`.
    """
    computation = Computation(
        source,
        {
            "modes": modes,
            "large": large,
            "material": material,
            "clamp": clamp,
            "unit": unit,
            "up": up,
            "damping": damping,
            "max-frequency": max_frequency,
            "freedoms": freedoms,
            "thickness": thickness,
            "threads": threads,
        },
        point_masses=point_masses,
        out=out,
        overwrite=overwrite,
        program=program,
    )
    return await run_cancelable(lambda: computation.run(progress), computation.cancel)
