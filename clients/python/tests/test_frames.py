from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PillowImage
from scenes import SIZE, beam

import modalcast as mc


def test_outputs_are_arrays_of_one_step(beams: mc.Scene):
    frame = beams.frame(outputs=("color", "depth", "domains", "normals", "depth_with_ground"), **SIZE)
    assert (frame.array.shape, frame.array.dtype) == ((90, 160, 3), np.uint8)
    assert (frame.depth.shape, frame.depth.dtype) == ((90, 160), np.float32)
    assert (frame.domains.shape, frame.domains.dtype) == ((90, 160), np.uint32)
    assert (frame.normals.shape, frame.normals.dtype) == ((90, 160, 3), np.float32)
    surface = frame.domains != mc.NO_DOMAIN
    assert set(np.unique(frame.domains[surface])) == {0, 1}
    assert np.array_equal(np.isfinite(frame.depth), surface)
    np.testing.assert_allclose(np.linalg.norm(frame.normals[surface], axis=1), 1, atol=1e-3)
    assert np.isfinite(frame["depth_with_ground"]).sum() > surface.sum()
    assert (frame.width, frame.height, frame.skipped, frame.camera_version) == (160, 90, 0, 0)
    assert "draw" in frame.stages
    with pytest.raises(KeyError, match="not 'displacement'"):
        _ = frame["displacement"]


def test_color_maps_have_parameters(beams: mc.Scene):
    with beams.drive() as drive:
        drive.step(q={"beam": [0.5, 0, 0]})
    outputs = [mc.Output("displacement", largest=1.0), mc.Output("mode_shape", mode=1)]
    frame = beams.frame(outputs=outputs, **SIZE)
    assert frame["displacement"].shape == frame["mode_shape"].shape == (90, 160, 3)
    assert np.array_equal(frame.array, frame["displacement"])
    assert beams.frame(outputs="depth", **SIZE).depth.shape == (90, 160)
    edges = beams.frame(outputs=mc.Output("color", edge_width=2.0), **SIZE)
    assert not np.array_equal(edges.array, beams.frame(**SIZE).array)
    jagged = beams.frame(outputs=mc.Output("color", samples=1), **SIZE)
    assert [frame.images["color"].head.look.samples for frame in (jagged, beams.frame(**SIZE))] == [1, 4]


def test_png_files_have_the_pixels_of_the_array(beams: mc.Scene, tmp_path: Path):
    raw = beams.frame(**SIZE)
    raw.save(tmp_path / "raw.png")
    raw.save(tmp_path / "raw.npy")
    encoded = beams.frame(format="png", **SIZE)
    encoded.save(tmp_path / "server.png")
    for name in ("raw.png", "server.png"):
        np.testing.assert_array_equal(np.asarray(PillowImage.open(tmp_path / name)), raw.array)
    np.testing.assert_array_equal(np.load(tmp_path / "raw.npy"), raw.array)
    shown = raw._repr_png_()
    assert shown is not None
    np.testing.assert_array_equal(np.asarray(PillowImage.open(io.BytesIO(shown))), raw.array)
    with pytest.raises(ValueError, match="format='raw'"):
        _ = encoded.array
    with pytest.raises(ValueError, match=re.escape("ends with .png or .npy")):
        raw.save(tmp_path / "frame.jpg")


def test_raw_colors_have_alpha_only_from_earlier_servers(beams: mc.Scene, tmp_path: Path):
    frame = beams.frame(**SIZE)
    beams._has_rgb = False
    earlier = beams.frame(**SIZE)
    assert (frame["color"].shape, earlier["color"].shape) == ((90, 160, 3), (90, 160, 4))
    assert (frame.array.flags.c_contiguous, len(frame.images["color"].data)) == (True, 3 * 90 * 160)
    np.testing.assert_array_equal(frame.array, earlier.array)
    np.testing.assert_array_equal(frame.rgba, earlier.rgba)
    assert (frame.rgba[..., 3] == 255).all()
    for number, saved in enumerate((frame, earlier)):
        saved.save(tmp_path / f"{number}.png")
        np.testing.assert_array_equal(np.asarray(PillowImage.open(tmp_path / f"{number}.png")), frame.array)
    with beams.drive() as drive, beams.frames(**SIZE, count=1) as frames:
        drive.step()
        assert next(frames)["color"].shape == (90, 160, 4)


def test_jpeg_is_close_to_raw(beams: mc.Scene, tmp_path: Path):
    frame = beams.frame(format="jpeg", jpeg_quality=95, **SIZE)
    frame.save(tmp_path / "frame.jpg")
    decoded = np.asarray(PillowImage.open(tmp_path / "frame.jpg")).astype(float)
    assert np.abs(decoded - beams.frame(**SIZE).array).mean() < 3
    assert frame._repr_png_() is None
    assert frame._repr_jpeg_() is not None


def test_pinhole_projects_vertices_to_pixels(beams: mc.Scene):
    K = np.array([[200.0, 0, 78], [0, 210.0, 47], [0, 0, 1]])
    # 3 m in front of the beam, looking along -z of the world: y down and z forward, as in OpenCV.
    pose = np.array([[1.0, 0, 0, 1], [0, -1, 0, 1], [0, 0, -1, 3.5]])
    camera = mc.pinhole(K, 160, 90, pose)
    frame = beams.frame(camera, outputs=("domains", "depth"))
    assert frame.domains.shape == (90, 160)
    # A point on the front face of the copy, at z = 1.1.
    point = np.array([0.6, 1.03, 1.1])
    in_camera = pose[:, :3].T @ (point - pose[:, 3])
    u, v, _ = K @ in_camera / in_camera[2]
    hit = beams.pick(int(u), int(v), camera)
    assert hit is not None
    assert beams.domains[hit.domain].name == "copy"
    np.testing.assert_allclose(hit.position, point, atol=1.5 * in_camera[2] / 200)
    assert frame.depth[int(v), int(u)] == pytest.approx(in_camera[2], rel=1e-3)
    opengl = mc.pinhole(K, 160, 90, pose * [1, -1, -1, 1], convention="opengl")
    np.testing.assert_array_equal(beams.frame(opengl, outputs=("domains",)).domains, frame.domains)


def test_cameras_of_a_batch_show_one_step(beams: mc.Scene):
    cameras = [
        mc.look_at((1, 1, 5), (1, 1, 0)),
        None,
        mc.look_at((5, 2, 0), (1, 1, 0), field_of_view=60).clipped(0.1, 9),
    ]
    frames = beams.frame_batch(cameras, outputs=("color", "depth"), **SIZE)
    assert len(frames) == 3
    assert len({frame.step for frame in frames}) == 1
    assert not np.array_equal(frames[0].array, frames[1].array)
    pose = np.eye(4)
    pose[:3, 3] = 1, 1, 5
    posed = beams.frame(mc.at_pose(pose), **SIZE)
    np.testing.assert_array_equal(posed.array, beams.frame(mc.look_at((1, 1, 5), (1, 1, 0)), **SIZE).array)


def test_invalid_pictures_name_expected_and_given(beams: mc.Scene):
    with pytest.raises(ValueError, match="got 17 cameras x 1 outputs"):
        beams.frame_batch([None] * 17)
    with pytest.raises(ValueError, match="each output once"):
        beams.frame(outputs=("color", "color"))
    with pytest.raises(ValueError, match="expected names from"):
        beams.frame(outputs=("colour",))  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match="camera: expected a Camera or None, got str"):
        beams.frame("front")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="width: expected at least 1 pixel, got 0"):
        beams.frame(width=0)
    camera = mc.pinhole(np.eye(3), 100, 100, np.eye(4))
    with pytest.raises(ValueError, match="width: expected 100, the width of the camera, got 90"):
        beams.frame(camera, width=90)
    with pytest.raises(ValueError, match=re.escape("K: expected shape (3, 3), got (4, 4)")):
        mc.pinhole(np.eye(4), 100, 100, np.eye(4))
    with pytest.raises(ValueError, match="fx 0 cx"):
        mc.pinhole(np.full((3, 3), 2.0), 100, 100, np.eye(4))
    with pytest.raises(mc.InvalidRequest) as error:
        beams.frame(width=100_000, height=10)
    assert error.value.field.endswith("width")
    assert "8192" in error.value.expected


def test_remarks_name_what_color_does_not_show(beams: mc.Scene):
    assert beams.frame(**SIZE).remarks == ()
    moved = np.eye(4)
    with beams.drive() as drive:
        moved[1, 3] = -0.5
        drive.step(transforms={"beam": moved})
        assert beams.frame(**SIZE).remarks == ("vertices lie up to 0.5000 m below the ground, which hides no geometry",)
        moved[:3, 3] = (1e5, 0, 0)
        drive.step(transforms={"beam": moved, "copy": moved})
        (remark,) = beams.frame(**SIZE).remarks
        assert remark.startswith("no domain is in the view of the rest state")


def test_frames_follow_a_drive(beams: mc.Scene):
    with beams.drive() as drive, beams.frames(delivery="lossless", count=3, **SIZE) as frames:
        for number in range(3):
            drive.step(q={"beam": [number / 10, 0, 0]}, wait=False)
        received = list(frames)
    assert [frame.step.number for frame in received] == [0, 1, 2]
    assert not np.array_equal(received[0].array, received[2].array)


def test_moved_camera_is_shown_without_a_step(beams: mc.Scene):
    camera = mc.look_at((1, 1, 5), (1, 1, 0))
    with beams.drive() as drive:
        drive.step()
    with beams.frames(camera, outputs=("color", "depth"), **SIZE) as frames:
        first = next(frames)
        assert frames.settings.pictures[0].width == 160
        version = frames.move_camera(mc.look_at((1, 3, 5), (1, 1, 0)))
        moved = next(frame for frame in frames if frame.camera_version >= version)
    assert not np.array_equal(first.array, moved.array)
    assert not np.array_equal(first.depth, moved.depth)
    with beams.frame_batches([camera, None], **SIZE) as batches:
        assert len(next(batches)) == 2
        with pytest.raises(ValueError, match="cameras: expected 2, got 1"):
            batches.move_cameras([camera])


def test_closed_stream_ends(beams: mc.Scene):
    frames = beams.frames(**SIZE)
    frames.close()
    assert list(frames) == []


def test_limit_of_rate_needs_delivery_latest(beams: mc.Scene):
    with pytest.raises(mc.InvalidRequest) as error:
        beams.frames(delivery="lossless", max_hz=10)
    assert error.value.field == "max_hz"
    with pytest.raises(ValueError, match="expected 'latest' or 'lossless', got 'newest'"):
        beams.frames(delivery="newest")  # pyright: ignore[reportArgumentType]


def test_hit_carries_modes_and_forces(beams: mc.Scene):
    camera = mc.look_at((1, 1, 6), (1, 1, 0), field_of_view=30)
    with beams.drive() as drive:
        drive.step(transforms={"copy": [[0, -1, 0, 2], [1, 0, 0, 0], [0, 0, 1, 1]]})
    hits = beams.pick_rectangle(60, 25, (40, 40), camera, **SIZE).hits
    hit = next(hit for hit in hits if hit.domain == 1)
    modes = beam()[2][list(hit.vertices)]
    np.testing.assert_allclose(hit.modes, np.einsum("v,vcr->cr", hit.barycentric, modes), atol=1e-6)
    force = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(hit.reduced_force(force), hit.modes.T @ hit.linear.T @ force, atol=1e-6)
    assert beams.pick(0, 0, camera, **SIZE) is None
    without = beams.pick_rectangle(60, 25, (40, 40), camera, modes=False, **SIZE)
    assert without.hits[0].modes.shape == (3, 0)
    with pytest.raises(mc.InvalidRequest):
        beams.pick(500, 0, camera, **SIZE)
    with pytest.raises(ValueError, match="at least 0"):
        beams.pick(-1, 0)
