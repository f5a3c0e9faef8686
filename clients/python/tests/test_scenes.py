from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scenes import RANK, beam, beam_builder

import modalcast as mc


def test_domains_are_found_by_name_and_index(tree: mc.Scene):
    trunk = tree.domains["trunk"]
    assert tree.domains[0] is trunk
    assert "trunk" in tree.domains
    assert (trunk.index, trunk.parent, trunk.notes["kind"]) == (0, None, "trunk")
    assert len(trunk.eigenvalues) == len(trunk.frequencies) == trunk.rank > 0
    with pytest.raises(KeyError, match=r"near names: .*'trunk'"):
        _ = tree.domains["trnk"]
    with pytest.raises(IndexError, match=f"below {len(tree.domains)}"):
        _ = tree.domains[10_000]
    assert repr(tree).startswith("<Scene 'tree': ")


def test_uploaded_arrays_are_described(beams: mc.Scene, tmp_path: Path):
    positions, faces, modes = beam()
    names = ("indices", "corner_vertices", "rest_positions", "uvs", "rest_normals", "modes")
    beams.describe(names, cache=str(tmp_path))
    received = beams.describe(names)
    for description in (received, beams.describe(names, cache=str(tmp_path))):
        shape = description.shape_of(description.domains["copy"])
        np.testing.assert_allclose(shape.arrays["rest_positions"], positions, atol=1e-6)
        np.testing.assert_allclose(shape.arrays["modes"].reshape(-1, 3, RANK), modes, atol=1e-6)
        np.testing.assert_array_equal(shape.faces, faces)
        for name in names:
            np.testing.assert_array_equal(received.shapes[0].arrays[name], shape.arrays[name])
    hashes = beams.describe(hashes=True).shapes[0].hashes
    assert {path.name for path in tmp_path.iterdir()} == {hashes[name].hex() for name in names}
    np.testing.assert_allclose(beams.modes("beam", [3, 1]).reshape(2, 3, RANK), modes[[3, 1]], atol=1e-6)
    assert beams.modes("copy").shape == (3 * len(positions), RANK)
    assert beams.domains["copy"].placement[2, 3] == 1
    assert beams.domains["beam"].eigenvalues.tolist() == [30, 40, 900]
    with pytest.raises(ValueError, match="arrays: expected names from"):
        beams.describe(["normals"])  # pyright: ignore[reportArgumentType]


def test_damaged_content_in_the_folder_is_read_again(beams: mc.Scene, tmp_path: Path):
    description = beams.describe(["modes"], cache=str(tmp_path))
    path = tmp_path / description.shapes[0].hashes["modes"].hex()
    path.write_bytes(b"damaged")
    np.testing.assert_array_equal(
        beams.describe(["modes"], cache=str(tmp_path)).shapes[0].arrays["modes"],
        description.shapes[0].arrays["modes"],
    )


def test_textures_have_pixels(tree: mc.Scene):
    textures = tree.describe(textures=True).textures
    assert textures
    for texture in textures.values():
        assert texture.pixels is not None
        assert texture.pixels.shape == (texture.height, texture.width, 4)


def test_wrong_arrays_name_expected_and_given():
    positions, faces, modes = beam()
    n = len(positions)
    cases: list[tuple[dict[str, object], str]] = [
        ({"positions": positions[:, :2]}, f"positions: expected shape (n, 3), got ({n}, 2)"),
        ({"faces": faces[:, :2]}, f"faces: expected triangles of shape (n, 3), got ({len(faces)}, 2)"),
        ({"faces": np.zeros((1, 4), int)}, "split the quadrilaterals"),
        ({"faces": faces.astype(float)}, "faces: expected integers, got the type float64"),
        ({"faces": faces + n}, f"faces: expected vertices of 0 to {n - 1}"),
        ({"modes": modes[1:]}, f"modes: expected shape ({n}, 3, n), got ({n - 1}, 3, {RANK})"),
        ({"modes": np.zeros((n, 4))}, f"modes: expected shape ({3 * n}, r) or ({n}, 3, r) for {n} positions"),
        ({"eigenvalues": [1.0]}, f"eigenvalues: expected shape ({RANK},), got (1,)"),
        ({"placement": np.eye(2)}, "placement: expected a matrix of shape (3, 4) or (4, 4), got (2, 2)"),
        ({"color": (1, 1)}, "color: expected shape (3,), got (2,)"),
    ]
    for arguments, message in cases:
        with pytest.raises(ValueError, match=re.escape(message)):
            mc.SceneBuilder("beam").add(**({"positions": positions, "faces": faces, "modes": modes} | arguments))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="a name that no earlier domain has, got 'beam'"):
        beam_builder("beams").add(positions, faces, name="beam")
    with pytest.raises(KeyError, match="no earlier domain is named 'bean'"):
        beam_builder("beams").add_copy("bean")


def test_server_names_the_invalid_field_of_an_upload(client: mc.Client):
    positions, faces, _ = beam()
    builder = mc.SceneBuilder("invalid").add(positions, faces, color=(2, 0, 0))
    with pytest.raises(mc.InvalidRequest) as error:
        client.upload(builder)
    assert error.value.field.startswith("domains[0].color")


def test_scene_of_same_name_is_replaced_on_request(client: mc.Client):
    positions, faces, modes = beam()
    progress: list[tuple[int, int]] = []
    client.add_scene("again", positions, faces, modes, progress=lambda sent, total: progress.append((sent, total)))
    assert progress[-1][0] == progress[-1][1] > 0
    with pytest.raises(mc.AlreadyExists) as error:
        client.add_scene("again", positions, faces)
    assert error.value.reason == "SCENE_NAME_TAKEN"
    scene = client.add_scene("again", positions, faces, replace=True, unit=0.5, up="z")
    assert (scene.coordinate_count, scene.info.unit, scene.info.up) == (0, 0.5, "z")
    assert client.scene("again").vertex_count == len(positions)
    scene.delete()
    with pytest.raises(mc.NotFound) as missing:
        scene.frame()
    assert missing.value.reason == "SCENE_NOT_FOUND"
    with pytest.raises(mc.NotFound, match="no open scene is named 'again'"):
        client.scene("again")


def test_unknown_source_lists_sources(client: mc.Client):
    with pytest.raises(mc.NotFound, match=r"sources .*'tree'"):
        client.open("three")


OBJ = """mtllib two.mtl
v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0
usemtl red\nf 1 2 3\nusemtl blue\nf 1 3 4
"""
MTL = "newmtl red\nKd 0.8 0.1 0.1\nnewmtl blue\nKd 0.1 0.1 0.8\n"


def test_uploaded_files_are_reused(client: mc.Client, tmp_path: Path):
    (tmp_path / "two.obj").write_text(OBJ)
    (tmp_path / "two.mtl").write_text(MTL)
    first = client.upload_files(tmp_path, "files", "two.obj")
    second = client.upload_files(tmp_path, "files2", "two.obj")
    assert first.vertex_count == second.vertex_count == 4
    description = second.describe()
    assert len(description.domains[0].material_ranges) == 2
    assert {material.name for material in description.materials.values()} == {"red", "blue"}
    third = client.upload_files(tmp_path, "files", "two.obj", replace=True)
    for scene in (second, third):
        scene.delete()
    single = client.upload_files(tmp_path / "two.obj", "single")
    assert single.vertex_count == 4
    single.delete()


def test_remarks_are_logged_when_a_scene_is_opened(client: mc.Client, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    (tmp_path / "two.obj").write_text(OBJ)
    scene = client.upload_files(tmp_path / "two.obj", "remarks")
    (remark,) = scene.remarks
    assert remark.startswith("material library 'two.mtl' does not exist: ")
    assert caplog.messages == [f"scene 'remarks': {remark}" for remark in scene.remarks]
    assert {(record.name, record.levelname) for record in caplog.records} == {("modalcast", "WARNING")}
    caplog.clear()
    assert client.scene("remarks").remarks == scene.remarks
    scene.delete()
    (tmp_path / "two.mtl").write_text(MTL)
    complete = client.upload_files(tmp_path, "remarks", "two.obj")
    assert complete.remarks == ()
    complete.delete()
    assert caplog.messages == []


def test_files_that_cannot_be_uploaded_are_named(client: mc.Client, tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="missing"):
        client.upload_files(tmp_path / "missing", "files")
    with pytest.raises(ValueError, match="got no files"):
        client.upload_files(tmp_path, "files")
    (tmp_path / "bad.obj").write_text("v 0 0 zero\n")
    with pytest.raises(mc.InvalidRequest) as error:
        client.upload_files(tmp_path / "bad.obj", "files")
    assert "bad.obj" in error.value.metadata["location"]
