from __future__ import annotations

import platform
import re
import subprocess
import sys

import numpy as np
import pytest
from scenes import beam

import modalcast as mc


def test_out_receives_positions(beams: mc.Scene):
    expected = beams.vertices()
    out = np.zeros((len(expected), 3), np.float32)
    assert beams.vertices(out=out) is out
    np.testing.assert_array_equal(out, expected)
    np.testing.assert_allclose(out[: len(out) // 2], beam()[0], atol=1e-6)


def test_out_of_another_shape_is_rejected(beams: mc.Scene):
    n = beams.vertex_count
    cases: list[tuple[np.ndarray, str]] = [
        (np.zeros((n, 2), np.float32), f"out: expected shape ({n}, 3), got ({n}, 2)"),
        (np.zeros((n, 3)), "expected a writable C-contiguous array of float32, got float64"),
        (np.zeros((3, n), np.float32).T, "contiguous False"),
    ]
    for out, message in cases:
        with pytest.raises(ValueError, match=re.escape(message)):
            beams.vertices(out=out)


def test_large_reply_fills_out_across_chunks(tree: mc.Scene):
    expected = tree.vertices()
    assert expected.nbytes > 1 << 20
    out = np.zeros_like(expected)
    tree.vertices(out=out)
    np.testing.assert_array_equal(out, expected)


# Reads the scene "large", and prints the page faults per reply.
COUNT_PAGE_FAULTS = """
import resource, sys
import numpy as np
import modalcast as mc
with mc.connect(sys.argv[1]) as client:
    scene = client.scene("large")
    out = np.zeros((scene.vertex_count, 3), np.float32)
    for _ in range(5):
        scene.vertices(out=out)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        scene.vertices(out=out)
    print((resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) / 20)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs the allocator of glibc")
def test_large_replies_reuse_their_memory(client: mc.Client):
    count = 400_000
    faces = np.arange(3 * (count // 3)).reshape(-1, 3)
    scene = client.add_scene("large", np.random.default_rng(0).random((count, 3)), faces, replace=True)
    command = [sys.executable, "-c", COUNT_PAGE_FAULTS, client.address]
    faults = float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    scene.delete()
    pages = 12 * count / 4096
    # Without it, there is about one fault per page.
    assert faults < 0.3 * pages


def test_encodings_differ_by_their_error_bounds(tree: mc.Scene):
    exact = tree.vertex_set()
    assert exact.positions is not None
    assert exact.normals is not None
    compact = tree.vertex_set({"positions": "u16_box", "normals": "octahedral_i16"})
    half = tree.vertex_set({"positions": "f16"}, domains=["trunk", 2])
    assert compact.positions is not None
    assert compact.normals is not None
    assert half.positions is not None
    extent = float(np.ptp(exact.positions, axis=0).max())
    np.testing.assert_allclose(compact.positions, exact.positions, atol=extent / 131070 + 1e-6)
    cosines = np.clip((compact.normals * exact.normals).sum(axis=1), -1, 1)
    assert np.degrees(np.arccos(cosines)).max() < 0.06  # 0.004 degrees and the rounding of arccos near 1
    assert half.domains == (0, 2)
    np.testing.assert_allclose(half.positions_of(2), exact.positions_of(2), rtol=2**-10, atol=1e-6)
    with pytest.raises(ValueError, match="positions of domain 1"):
        half.positions_of(1)


def test_unknown_attributes_are_rejected(beams: mc.Scene):
    with pytest.raises(ValueError, match="attributes: expected names from"):
        beams.vertex_set(("position",))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="encoding of positions: expected one of"):
        beams.vertex_set({"positions": "f64"})  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="at least one"):
        beams.vertex_set(())
    with pytest.raises(mc.InvalidRequest, match="displacements"):
        beams.vertex_set(("displacements",))


def test_streams_have_every_step(beams: mc.Scene):
    with (
        beams.vertex_sets(("positions", "normals"), delivery="lossless", count=3) as vertex_sets,
        beams.steps(delivery="lossless", count=3) as states,
        beams.drive() as drive,
    ):
        for number in range(3):
            drive.step(q={"copy": [number, 0, 0]}, wait=False)
        received = list(vertex_sets)
        changes = list(states)
    assert [vertex_set.step.number for vertex_set in received] == [0, 1, 2]
    n = beams.domains["beam"].vertex_count
    for number, vertex_set in enumerate(received):
        expected = beam()[0] + [0, 0, 1] + beam()[2] @ [number, 0, 0]
        np.testing.assert_allclose(vertex_set.positions_of(1), expected, atol=1e-6)
        assert vertex_set.vertex_counts == (n, n)
    assert [state.q_of("copy")[0] for state in changes] == [0, 1, 2]


def test_state_computes_the_vertices(tree: mc.Scene):
    q = np.zeros(tree.domains["trunk"].rank)
    q[0] = 3
    with tree.drive() as drive:
        step = drive.step(q={"trunk": q})
        state, vertex_set = tree.state(step=step), tree.vertex_set(("positions",), step=step)
    description = tree.describe(["rest_positions", "modes"])
    for domain in list(tree.domains)[:40]:
        arrays = description.shape_of(domain).arrays
        local = arrays["rest_positions"].astype(np.float64)
        if domain.rank > 0:
            local += (arrays["modes"] @ state.q_of(domain)).reshape(-1, 3)
        T = state.transform_of(domain)
        np.testing.assert_allclose(vertex_set.positions_of(domain), local @ T[:, :3].T + T[:, 3], atol=2e-5)
    tree.reset()


def test_forces_reach_the_physics_process(beams: mc.Scene):
    camera = mc.look_at((1, 1, 6), (1, 1, 0), field_of_view=30)
    hits = beams.pick_rectangle(60, 25, (40, 40), camera, width=160, height=90).hits
    hit = hits[0]
    with beams.forces() as received:
        assert next(received).forces == ()
        owner = beams.apply_forces([hit.force((0, 2, 1)), mc.modal_force("copy", [1, 2, 3])], lifetime=5)
        surface, modal = next(received).forces
        assert surface.owner == modal.owner == owner
        np.testing.assert_allclose(surface.f_q, hit.reduced_force((0, 2, 1)), rtol=1e-5)
        assert surface.vector is not None
        assert surface.vector.tolist() == [0, 2, 1]
        assert (modal.domain, modal.f_q.tolist(), modal.vector) == (1, [1, 2, 3], None)
        assert beams.apply_forces([]) == 0
        assert next(received).forces == ()
    with pytest.raises(ValueError, match=re.escape("f_q of domain 'copy': expected shape (3,), got (2,)")):
        beams.apply_forces([mc.modal_force("copy", [1, 2])])
    with pytest.raises(mc.InvalidRequest):
        beams.apply_forces([mc.surface_force("beam", 10**6, (1, 0, 0), (0, 0, 1))])
