"""The rigid fit of joints, without a server."""

from __future__ import annotations

import numpy as np

from modalcast.kinematics import nearest_rotations


def rotation(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    """Rodrigues' formula."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def correlation(rest: np.ndarray, current: np.ndarray) -> np.ndarray:
    return (current - current.mean(axis=0)).T @ (rest - rest.mean(axis=0))


def test_rotation_of_points_is_recovered():
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    circle = np.column_stack((np.cos(angles), np.full(8, 2.0), np.sin(angles)))
    expected = [rotation((1, 2, -0.5), angle) for angle in (0, 1e-9, 0.3, 1.5, 3.0)]
    fitted = nearest_rotations(np.array([correlation(circle, circle @ turn.T) for turn in expected]))
    np.testing.assert_allclose(fitted, expected, atol=1e-12)


def test_fit_of_mirrored_points_is_a_proper_rotation():
    points = np.vstack((np.eye(3), np.zeros(3)))
    fitted = nearest_rotations(correlation(points, points * [-1, 1, 1])[None])[0]
    np.testing.assert_allclose(fitted @ fitted.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(fitted), 1)


def test_points_on_a_line_do_not_rotate():
    line = np.outer(np.arange(5.0), (1, 2, 3))
    turned = line @ rotation((0, 0, 1), 1).T
    np.testing.assert_array_equal(nearest_rotations(correlation(line, turned)[None]), np.eye(3)[None])
    np.testing.assert_array_equal(nearest_rotations(np.zeros((1, 3, 3))), np.eye(3)[None])
