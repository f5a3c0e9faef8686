"""Modes that the program `modalcast model` computes: with a stand-in for the program, and with the program itself."""

from __future__ import annotations

import asyncio
import json
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from test_conversions import run_tool

import modalcast as mc
from modalcast import aio
from modalcast._server_process import find_program

VERTICES = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 0.7) for z in (0.0, 0.4)])
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])

# Answers as the program does. It fails for the material "unknown", and never ends for the material "endless".
STAND_IN = """
import json, pathlib, sys, time
import numpy as np
arguments = sys.argv[1:]
pathlib.Path(sys.argv[0]).with_name("arguments.json").write_text(json.dumps(arguments))
print("progress 0.250 assembly", file=sys.stderr, flush=True)
if "--material=unknown" in arguments:
    print("a warning", file=sys.stderr)
    sys.exit("error: material: expected a known name, got 'unknown'")
if "--material=endless" in arguments:
    time.sleep(600)
print("progress 1.000 done", file=sys.stderr, flush=True)
with np.load(arguments[-1]) as surface:
    vertices, faces = surface["vertices"], np.uint32(surface["faces"])[:, :3]
notes = np.frombuffer(json.dumps({"modes.material": "steel"}).encode(), np.uint8)
U = np.ones((len(vertices), 3, 2), np.float32)
out = next(argument for argument in arguments if argument.startswith("--out=")).removeprefix("--out=")
np.savez(out, vertices=vertices, faces=faces, U=U, eigenvalues=[(2 * np.pi) ** 2, (4 * np.pi) ** 2], notes=notes)
print(json.dumps({"out": out, "vertices": len(vertices), "freedoms": 81, "parts": 1, "rigid_modes": 6, "mass": 2.5,
                  "size": [1.0, 0.7, 0.4], "frequencies": [1.0, 2.0], "frequency_errors": [0.01, None],
                  "remarks": ["free"]}))
"""


@pytest.fixture
def stand_in(tmp_path: Path) -> Path:
    path = tmp_path / "modalcast"
    path.write_text(f"#!{sys.executable}\n{STAND_IN}")
    path.chmod(0o755)
    return path


def arguments_of(stand_in: Path) -> list[str]:
    return json.loads(stand_in.with_name("arguments.json").read_text())


def test_arguments_become_flags(stand_in: Path, tmp_path: Path):
    calls: list[tuple[float, str]] = []
    model = mc.make_model(
        (VERTICES, QUADS),
        clamp=["-x < 0.5", "group base"],
        material="E=1e6,nu=0.3,rho=1000",
        point_masses=[[0, 0, -1.5, 2]],
        max_frequency=100,
        out=tmp_path / "kept.npz",
        progress=lambda fraction, stage: calls.append((fraction, stage)),
        program=stand_in,
    )
    command, *flags, separator, source = arguments_of(stand_in)
    assert (command, separator) == ("model", "--")
    assert flags == [
        "--material=E=1e6,nu=0.3,rho=1000",
        "--clamp=-x < 0.5",
        "--clamp=group base",
        "--max-frequency=100",
        "--point-mass=0.0 0.0 -1.5 2.0",
        f"--out={tmp_path / 'kept.npz'}",
        "--json",
        "--progress=lines",
    ]
    assert not Path(source).exists(), "expected that the file with the arrays is removed"
    assert (tmp_path / "kept.npz").exists()
    assert calls == [(0.25, "assembly"), (1.0, "done")]
    assert model.frequencies == pytest.approx([1, 2])
    assert (model.positions == VERTICES).all()
    assert model.modes.shape == (8, 3, 2)
    assert model.notes == {"modes.material": "steel"}
    assert model.frequency_errors[0] == 0.01
    assert np.isnan(model.frequency_errors[1])
    assert (model.mass, model.size, model.rigid_modes, model.remarks) == (2.5, (1.0, 0.7, 0.4), 6, ("free",))
    mc.SceneBuilder("part", up="z").add(model.positions, model.faces, model.modes, eigenvalues=model.eigenvalues)


def test_large_motion_needs_a_file(stand_in: Path, tmp_path: Path):
    mc.make_model((VERTICES, QUADS), modes=4, large=True, out=tmp_path / "kept.npz", program=stand_in)
    assert arguments_of(stand_in)[1:3] == ["--modes=4", "--large"]
    mc.make_model((VERTICES, QUADS), large=False, program=stand_in)
    assert "--large" not in arguments_of(stand_in)
    with pytest.raises(
        ValueError, match=r"^out: expected a file, beside which large=True writes cubic forces, got None$"
    ):
        mc.make_model((VERTICES, QUADS), large=True, program=stand_in)


def test_progress_line_is_cleared(stand_in: Path, capfd: pytest.CaptureFixture[str]):
    mc.make_model((VERTICES, QUADS), progress=True, program=stand_in)
    shown = capfd.readouterr().err
    assert "25% assembly" in shown
    assert "100% done" in shown
    assert shown.endswith("\r")
    mc.make_model((VERTICES, QUADS), program=stand_in)
    assert capfd.readouterr().err == ""


def test_messages_of_the_program_are_errors(stand_in: Path, tmp_path: Path):
    with pytest.raises(mc.ModelingError, match=r"^a warning\nerror: material: expected a known name, got 'unknown'$"):
        mc.make_model((VERTICES, QUADS), material="unknown", program=stand_in)
    with pytest.raises(mc.ModelingError, match="found no program"):
        mc.make_model((VERTICES, QUADS), program=tmp_path / "absent")
    for vertices, faces, message in [
        (VERTICES[:, :2], QUADS, r"vertices: expected shape \(n, 3\), got \(8, 2\)"),
        (VERTICES, QUADS[:, :2], r"faces: expected shape \(m, 3\) or \(m, 4\), got \(6, 2\)"),
        (VERTICES, QUADS + 0.5, "faces: expected integers"),
    ]:
        with pytest.raises(ValueError, match=message):
            mc.make_model((vertices, faces), program=stand_in)
    with pytest.raises(ValueError, match=r"point_masses: expected shape \(n, 4\), got \(3,\)"):
        mc.make_model((VERTICES, QUADS), point_masses=[0, 0, 1], program=stand_in)
    stand_in.write_text("#!/bin/sh\necho 1\n")
    with pytest.raises(mc.ModelingError, match="expected a report"):
        mc.make_model((VERTICES, QUADS), program=stand_in)


def processes_of(stand_in: Path) -> list[Path]:
    name = str(stand_in).encode()
    found: list[Path] = []
    for process in Path("/proc").iterdir():
        if process.name.isdecimal():
            try:
                command = (process / "cmdline").read_bytes()
            except OSError:
                continue
            if name in command:
                found.append(process)
    return found


def test_exception_of_the_progress_function_ends_the_program(stand_in: Path):
    def interrupt(fraction: float, stage: str) -> None:
        assert processes_of(stand_in), "negative control: the program runs"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mc.make_model((VERTICES, QUADS), material="endless", progress=interrupt, program=stand_in)
    assert not processes_of(stand_in)


def test_ctrl_c_ends_the_program(stand_in: Path):
    interrupt = threading.Event()

    def send_signal() -> None:
        interrupt.wait()
        time.sleep(0.2)
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    thread = threading.Thread(target=send_signal)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        mc.make_model((VERTICES, QUADS), material="endless", progress=lambda *_: interrupt.set(), program=stand_in)
    thread.join()
    assert not processes_of(stand_in)


def test_asyncio_computes_and_cancels(stand_in: Path):
    async def compute() -> None:
        model = await aio.make_model((VERTICES, QUADS), program=stand_in)
        assert model.modes.shape == (8, 3, 2)
        started = asyncio.Event()
        loop = asyncio.get_running_loop()
        task = asyncio.create_task(
            aio.make_model(
                (VERTICES, QUADS),
                material="endless",
                progress=lambda *_: loop.call_soon_threadsafe(started.set),
                program=stand_in,
            )
        )
        await started.wait()
        assert processes_of(stand_in)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert not processes_of(stand_in)

    asyncio.run(compute())


@pytest.fixture
def program() -> str:
    """The program itself, of which a build of the server alone has no part that computes modes."""
    path = Path(find_program(None)).resolve()
    if not path.with_name("modalcast-modes").exists():
        pytest.skip(f"{path.parent} has no modalcast-modes")
    return str(path)


def test_box_has_its_mass_and_frequencies(program: str, client: mc.Client):
    stages: list[str] = []
    model = mc.make_model(
        (VERTICES, QUADS),
        modes=6,
        material="E=1e6,nu=0.3,rho=1000",
        progress=lambda _, stage: stages.append(stage),
        program=program,
    )
    # Of a free box, in Hz, by a Rayleigh-Ritz computation with polynomials.
    assert model.frequencies == pytest.approx([7.577, 9.163, 11.757, 14.721, 14.797, 15.252], rel=0.002)
    assert (model.rigid_modes, model.parts) == (6, 1)
    assert model.mass == pytest.approx(280, rel=1e-5)
    assert model.size == pytest.approx((1, 0.7, 0.4))
    assert stages
    scene = client.upload(
        mc.SceneBuilder("modeled-box", up="z").add(
            model.positions, model.faces, model.modes, eigenvalues=model.eigenvalues
        )
    )
    with scene.drive() as drive:
        drive.step(q=[1, 0, 0, 0, 0, 0])
    assert np.abs(scene.vertices() - model.positions).max() == pytest.approx(
        np.abs(model.modes[..., 0]).max(), rel=0.01
    )
    scene.delete()


def write_beam(path: Path, cubes: int) -> None:
    """Writes a beam of cubes along x, each of six tetrahedra, as a file of Gmsh (version 2)."""
    nodes = [(x / cubes, y / cubes, z / cubes) for x in range(cubes + 1) for y in (0, 1) for z in (0, 1)]
    # Along the six paths of edges from one corner of a cube to the opposite one.
    paths = [(1, 3), (1, 5), (2, 3), (2, 6), (4, 5), (4, 6)]
    corners = [
        (0, a, b, 7) if is_even else (0, b, a, 7) for (a, b), is_even in zip(paths, [1, 0, 0, 1, 1, 0], strict=True)
    ]
    elements = [
        [4 * x + 1 + _corner(corner) for corner in tetrahedron] for x in range(cubes) for tetrahedron in corners
    ]
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$Nodes", str(len(nodes))]
    lines += [f"{index} {x} {y} {z}" for index, (x, y, z) in enumerate(nodes, 1)]
    lines += ["$EndNodes", "$Elements", str(len(elements))]
    lines += [f"{index} 4 0 {' '.join(map(str, element))}" for index, element in enumerate(elements, 1)]
    path.write_text("\n".join([*lines, "$EndElements", ""]))


def _corner(bits: int) -> int:
    """The node of a corner of a cube: bit 0 is the step along x, bit 1 along y, bit 2 along z."""
    return 4 * (bits & 1) + 2 * (bits >> 1 & 1) + (bits >> 2)


def test_large_motion_of_a_beam_has_cubic_forces(program: str, tmp_path: Path):
    write_beam(tmp_path / "beam.msh", 6)

    def make(out: str, *, large: bool) -> mc.ModalModel:
        source, material = tmp_path / "beam.msh", "E=1e6,nu=0.3,rho=1000"
        return mc.make_model(
            source, modes=2, large=large, material=material, clamp="x < 0.01", program=program, out=tmp_path / out
        )

    model = make("beam.npz", large=True)
    assert model.modes.shape[2] == 5, "two modes with three derivatives"
    assert "modes.cubic_sha256" in model.notes
    coefficients = 5 + 15 + 35
    assert (tmp_path / "beam.cub").stat().st_size >= 8 * 5 * coefficients
    linear = make("linear.npz", large=False)
    assert linear.modes.shape[2] == 2
    assert not (tmp_path / "linear.cub").exists(), "control"


def test_program_rejects_bad_input(program: str, tmp_path: Path):
    out = tmp_path / "part.npz"
    for clamp, material, message in [
        ("x < -5", "steel", "clamp"),
        (None, "E=1e6,nu=0.5,rho=1000", "nu"),
        (None, "cheese", "cheese"),
    ]:
        with pytest.raises(mc.ModelingError, match=message):
            mc.make_model((VERTICES, QUADS), clamp=clamp, material=material, out=out, program=program)
        assert list(tmp_path.iterdir()) == []


def page_commands() -> list[str]:
    """The shell commands of the page's section on CAD parts."""
    page = (Path(__file__).parents[2] / "modes/README.md").read_text()
    section = page.split("## I have a CAD part", 1)[1].split("\n## ", 1)[0]
    blocks = section.split("```sh\n")[1:]
    return [line for block in blocks for line in block.split("```", 1)[0].splitlines() if line]


def test_commands_for_a_cad_part_run(program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "bracket.geo").write_text(
        'SetFactory("OpenCASCADE");\nBox(1) = {0, 0, 0, 60, 40, 5};\nBox(2) = {0, 0, 5, 5, 40, 35};\n'
        "BooleanUnion(3) = { Volume{1}; Delete; }{ Volume{2}; Delete; };\nCylinder(4) = {35, 20, -1, 0, 0, 7, 6};\n"
        "BooleanDifference(5) = { Volume{3}; Delete; }{ Volume{4}; Delete; };\n"
    )
    run_tool("gmsh", "bracket.geo", "-0", "-o", "part.step", folder=tmp_path)
    for folder in (Path(program).parent, Path(sys.executable).parent):
        monkeypatch.setenv("PATH", str(folder), prepend=":")
    ran: list[str] = []
    for command in page_commands():
        name = command.split()[0]
        # Installations and the viewer need a network and a browser.
        if name in {"pip", "apt-get"} or command.startswith("modalcast view") or shutil.which(name) is None:
            continue
        result = subprocess.run(command, shell=True, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert result.returncode == 0, f"{command}: {result.stdout}{result.stderr}"
        ran.append(name)
    assert "gmsh" in ran
    assert "modalcast" in ran
    with np.load(tmp_path / "part.npz") as arrays:
        size = np.ptp(arrays["vertices"], axis=0)
        assert size == pytest.approx([0.06, 0.04, 0.04], rel=1e-3), "expected millimeters in meters"
        assert arrays["U"].shape[2] == 20
