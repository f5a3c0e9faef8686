"""Files of other formats are rejected with a command, which converts them to a scene that opens."""

from __future__ import annotations

import base64
import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_surface import POINTS, TETRAHEDRA

from modalcast._server_process import find_program

PAGE = Path(__file__).parents[3] / "src/model/load/manifest/README.md"
NAME = "a part's"
PYRAMID = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0.5 0.5 1\nf 3 2 1\nf 4 3 1\nf 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n"
MODES = np.arange(30.0).reshape(15, 2)
BLENDER = ("blender", "--background", "--python-exit-code", "1", "--python-expr")


def extensions() -> Iterator[str]:
    """The extensions with a conversion. A test of the loaders compares the page with the commands in errors."""
    for cell in re.findall(r"^\| ([^|]+) \| `[^|`]* OUTPUT\.\w+`", PAGE.read_text(), re.MULTILINE):
        yield from re.findall(r"`\.(\w+)`", cell)


def run(*command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    # Programs in the folder of this Python come first, as in an activated environment.
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": path}
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=environment)


def run_tool(*command: str, folder: Path) -> None:
    """Runs a tool that writes an input. Skips the test without it."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    if shutil.which(command[0], path=path) is None:
        pytest.skip(f"needs the program {command[0]}")
    result = run(*command, folder=folder)
    # The package of Gmsh does not contain the libraries of a desktop.
    missing = re.search(r"\S+: cannot open shared object file", result.stderr)
    if missing:
        pytest.skip(f"{command[0]} does not start: {missing[0]}")
    assert result.returncode == 0, result.stdout + result.stderr


def inspect(path: str, folder: Path) -> subprocess.CompletedProcess[str]:
    # The path of the program may be relative to the folder in which the tests run.
    return run(str(Path(find_program(None)).resolve()), "inspect", path, folder=folder)


def total(output: str, name: str) -> int:
    found = re.search(rf"^total {name} +(\d+)$", output, re.MULTILINE)
    assert found, output
    return int(found[1])


def write_volume(path: Path) -> None:
    meshio: Any = pytest.importorskip("meshio")
    meshio.write(path, meshio.Mesh(POINTS, [("tetra", np.array(TETRAHEDRA))]))


def write_triangles(path: Path) -> None:
    meshio: Any = pytest.importorskip("meshio")
    meshio.write(path, meshio.Mesh(POINTS[:4], [("triangle", np.array([[0, 1, 2], [0, 2, 3]]))]))


def write_poly_data(path: Path) -> None:
    pyvista: Any = pytest.importorskip("pyvista")
    pyvista.PolyData(POINTS[:4], [3, 0, 1, 2, 3, 0, 2, 3]).save(path)


def write_by_gmsh(path: Path) -> None:
    geometry = path.with_name("box.geo")
    geometry.write_text('SetFactory("OpenCASCADE");\nBox(1) = {0, 0, 0, 1, 2, 3};\n')
    dimension = "-3" if path.suffix == ".msh" else "-0"
    run_tool("gmsh", geometry.name, dimension, "-o", path.name, folder=path.parent)


def write_by_assimp(path: Path) -> None:
    path.with_name("pyramid.obj").write_text(PYRAMID)
    run_tool("assimp", "export", "pyramid.obj", path.name, folder=path.parent)
    path.with_name("pyramid.obj").unlink()


def write_by_blender(path: Path) -> None:
    """Writes the cube that a new file of Blender contains."""
    export = {".abc": "alembic_export", ".blend": "save_as_mainfile"}.get(path.suffix, "usd_export")
    option = {".abc": "alembic", ".blend": ""}.get(path.suffix, "usd")
    expression = "import bpy, sys; "
    if option:
        # Debian's Blender has neither.
        expression += f"bpy.app.build_options.{option} or sys.exit(0); "
    run_tool(*BLENDER, f"{expression}bpy.ops.wm.{export}(filepath=sys.argv[-1])", "--", str(path), folder=path.parent)
    if not path.exists():
        pytest.skip(f"needs a Blender that can write {path.suffix}")


def write_plain_gltf(path: Path) -> None:
    """Writes the pyramid without compression."""
    rows = [line.split() for line in PYRAMID.splitlines()]
    positions = np.array([[float(word) for word in row[1:]] for row in rows if row[0] == "v"], "<f4")
    indices = np.array([[int(word) - 1 for word in row[1:]] for row in rows if row[0] == "f"], "<u2")
    data = positions.tobytes() + indices.tobytes()
    uri = f"data:application/octet-stream;base64,{base64.b64encode(data).decode()}"
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(positions), "type": "VEC3", **bounds},
            {"bufferView": 1, "componentType": 5123, "count": indices.size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": positions.nbytes},
            {"buffer": 0, "byteOffset": positions.nbytes, "byteLength": indices.nbytes},
        ],
        "buffers": [{"byteLength": len(data), "uri": uri}],
    }
    path.write_text(json.dumps(document))


def write_modes(path: Path) -> None:
    path.with_name("scene.toml").write_text(f'model = "pyramid.obj"\nmodes = "{path.name}"\n')
    path.with_name("pyramid.obj").write_text(PYRAMID)
    if path.suffix == ".mat":
        scipy_io: Any = pytest.importorskip("scipy.io")
        scipy_io.savemat(path, {"U": MODES})
    elif path.suffix == ".csv":
        np.savetxt(path, MODES, delimiter=",")
    else:
        h5py: Any = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            file["U"] = MODES


# How an input is written, and the numbers of vertices and triangles of the scene; None if they depend on the tool.
Case = tuple[Callable[[Path], None], int | None, int | None]
OTHERS: dict[str, Case] = {
    "off": (write_triangles, 4, 2),
    "vtp": (write_poly_data, 4, 2),
    **dict.fromkeys(("msh", "step", "stp", "iges", "igs"), (write_by_gmsh, None, None)),
    **dict.fromkeys(("fbx", "dae", "3ds", "3mf", "x3d"), (write_by_assimp, None, 6)),
    **dict.fromkeys(("blend", "usd", "usda", "usdc", "usdz", "abc"), (write_by_blender, None, 12)),
    **dict.fromkeys(("mat", "h5", "hdf5", "csv"), (write_modes, 5, 6)),
}


def convert_by_hint(scene: str, folder: Path) -> str:
    """Runs the command of the error about a scene. Returns the name of the converted file."""
    rejected = inspect(scene, folder)
    assert rejected.returncode == 3, rejected.stderr
    hint = re.search(r"\(convert it in its folder with `(.+)` after .+\)$", rejected.stderr)
    assert hint, rejected.stderr
    converted = run("sh", "-c", hint[1], folder=folder)
    assert converted.returncode == 0, converted.stdout + converted.stderr
    return shlex.split(hint[1])[-1]


@pytest.mark.parametrize("extension", list(extensions()))
def test_command_of_the_error_converts(extension: str, tmp_path: Path):
    write, vertices, triangles = OTHERS.get(extension, (write_volume, 9, 12))
    path = tmp_path / f"{NAME}.{extension}"
    write(path)
    is_modes = write is write_modes
    output = convert_by_hint("scene.toml" if is_modes else path.name, tmp_path)
    assert Path(output).stem == NAME
    if is_modes:
        (tmp_path / "scene.toml").write_text(f'model = "pyramid.obj"\nmodes = "{output}"\n')
    opened = inspect("scene.toml" if is_modes else output, tmp_path)
    assert opened.returncode == 0, opened.stderr
    assert total(opened.stdout, "coordinates") == (2 if is_modes else 0)
    assert vertices is None or total(opened.stdout, "vertices") == vertices
    assert total(opened.stdout, "triangles") >= (triangles or 12)
    assert triangles is None or total(opened.stdout, "triangles") == triangles


@pytest.mark.parametrize("extension", ["glb", "gltf"])
@pytest.mark.parametrize("compression", ["draco", "meshopt"])
def test_command_of_a_compressed_model_decompresses(compression: str, extension: str, tmp_path: Path):
    write_plain_gltf(tmp_path / "plain.gltf")
    name = f"{NAME}.{extension}"
    run_tool("gltf-transform", compression, "plain.gltf", name, folder=tmp_path)
    output = convert_by_hint(name, tmp_path)
    assert output == f"{NAME}.uncompressed.glb"
    opened = inspect(output, tmp_path)
    assert opened.returncode == 0, opened.stderr
    assert total(opened.stdout, "vertices") == 5
    assert total(opened.stdout, "triangles") == 6


def test_extensions_are_those_of_the_page():
    assert len(list(extensions())) >= 30
    assert set(OTHERS) < set(extensions())


def test_poly_data_in_a_vtk_file_needs_pyvista(tmp_path: Path):
    points = "0 0 0 1 0 0 1 1 0 0 1 0"
    text = (
        f"# vtk DataFile Version 3.0\na\nASCII\nDATASET POLYDATA\nPOINTS 4 float\n{points}\nPOLYGONS 1 5\n4 0 1 2 3\n"
    )
    (tmp_path / "part.vtk").write_text(text)
    result = run("python3", "-m", "modalcast.surface", "part.vtk", "part.ply", folder=tmp_path)
    if importlib.util.find_spec("pyvista") is None:
        assert result.returncode == 1
        assert result.stderr.endswith("Install it with: pip install pyvista\n")
    else:
        assert result.returncode == 0, result.stderr
        assert total(inspect("part.ply", tmp_path).stdout, "triangles") == 2


def test_unreadable_meshes_are_errors(tmp_path: Path):
    pytest.importorskip("meshio")
    for name, content, message in [
        ("absent.msh", None, "not found"),
        ("damaged.vtu", "<a>", "Couldn't read"),
        ("damaged.bdf", "a", "damaged.bdf: expected a readable mesh, got RuntimeError"),
    ]:
        if content is not None:
            (tmp_path / name).write_text(content)
        result = run("python3", "-m", "modalcast.surface", name, "out.ply", folder=tmp_path)
        assert result.returncode == 1, name
        assert message in result.stderr
        assert "Traceback" not in result.stderr
        assert not (tmp_path / "out.ply").exists()
