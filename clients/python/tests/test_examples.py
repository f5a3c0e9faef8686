"""The examples run, and their results are checked."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import modalcast as mc

EXAMPLES = Path(__file__).parent.parent / "examples"


def run_example(name: str, client: mc.Client, folder: Path) -> str:
    """Runs an example in a folder and returns its output."""
    # One thread, because the server uses the other cores.
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, EXAMPLES / name, client.address]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=environment)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_beam_has_the_frequencies_of_beam_theory(client: mc.Client, tmp_path: Path):
    output = run_example("beam.py", client, tmp_path)
    frequencies = [float(number) for number in re.findall(r"\d+\.\d", output)]
    # The first bending mode of an Euler-Bernoulli beam that is clamped at one end.
    expected = 1.8751**2 / (2 * np.pi) * np.sqrt(210e9 / 7850) * 0.2 / np.sqrt(12) / 4.0**2
    assert frequencies[0] == pytest.approx(expected, rel=0.02)
    pixels = np.asarray(Image.open(tmp_path / "beam.png")).astype(int)
    # The beam with the first mode is red.
    assert ((pixels[..., 0] - pixels[..., 2]) > 60).mean() > 0.02
    client.delete("beams")


def test_pulled_tree_moves_and_returns(client: mc.Client, tmp_path: Path):
    output = run_example("pull.py", client, tmp_path)
    pulled, released = (float(number) for number in re.findall(r"(-?\d+\.\d+) m", output))
    assert pulled > 0.5
    assert abs(released) < pulled / 2
    assert (tmp_path / "pulled.png").read_bytes() != (tmp_path / "released.png").read_bytes()
    client.open("tree").reset()


def test_rigid_bodies_fall_onto_table_and_ground(client: mc.Client, tmp_path: Path):
    pytest.importorskip("mujoco")
    output = run_example("rigid_bodies.py", client, tmp_path)
    on_table, bodies, lowest = (float(number) for number in re.findall(r"\d+(?:\.\d+)?", output))
    # A body that was not moved would be above 0.8 m, and one without a table or a ground below would fall on.
    assert 0 < on_table <= bodies == 16
    assert 0.15 < lowest < 0.7
    assert (tmp_path / "bodies.png").stat().st_size > 10_000
    client.delete("bodies")


def test_rerun_recording_has_the_vertices_of_each_step(client: mc.Client, tmp_path: Path):
    pytest.importorskip("rerun")
    run_example("log_to_rerun.py", client, tmp_path)
    command = [sys.executable, "-m", "rerun", "rrd", "print", "tree.rrd"]
    output = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    rows = re.findall(r"with (\d+) rows .* - /scene/tree - data columns: .*vertex_normals.*vertex_positions", output)
    assert sum(map(int, rows)) == 8
    client.open("tree").reset()


def test_beams_reach_their_targets_and_a_mask_resets_some_worlds(client: mc.Client):
    spec = importlib.util.spec_from_file_location("reach", EXAMPLES / "reach.py")
    assert spec is not None
    assert spec.loader is not None
    reach = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(reach)
    env = reach.BeamReach(client, 16)
    pixels, info = env.reset(seed=3)
    assert pixels in env.observation_space
    assert len(np.unique(pixels.reshape(16, -1), axis=0)) == 16, "expected a target of its own in each world"
    start = info["distance"]
    _, reward, terminated, truncated, _ = env.step(np.zeros((16, reach.MODES)))
    np.testing.assert_allclose(-reward, start)
    for _ in range(reach.EPISODE - 1):
        assert not truncated.any()
        # Moves the tip straight to the target.
        tips = env._tip + env._q @ env._tip_modes.T
        error = env._transforms[:, 1, :, 3] - tips
        pixels, reward, terminated, truncated, info = env.step(error @ np.linalg.pinv(env._tip_modes).T / reach.STEP)
    assert truncated.all()
    assert not terminated.any()
    assert info["distance"].mean() < 0.2 * start.mean(), "the actions do not move the tip to the target"
    mask = np.arange(16) % 2 == 0
    after, info = env.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(after[~mask], pixels[~mask])
    assert (after[mask] != pixels[mask]).any(axis=(1, 2, 3)).all()
    assert (info["distance"][mask] > 0.05).all()
    env.close()
    client.delete("reach")
