"""Types of arrays, and conversions that state the expected and the given shape in their errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Bytes: TypeAlias = NDArray[np.uint8]
F32: TypeAlias = NDArray[np.float32]
F64: TypeAlias = NDArray[np.float64]
U32: TypeAlias = NDArray[np.uint32]

Vector: TypeAlias = Sequence[float] | F64 | F32
"""Three numbers."""


def to_f32(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> F32:
    """Converts to a C-contiguous f32 array. None in `shape` permits any length.

    Raises:
        ValueError: The array has another shape, or a number exceeds the range of f32.
    """
    given = _real_array(name, values)
    check_shape(name, given, shape)
    with np.errstate(over="ignore"):
        converted = np.ascontiguousarray(given, dtype="<f4")
    if np.isinf(converted).sum() != np.isinf(given).sum():
        largest = float(np.abs(given).max())
        raise ValueError(f"{name}: expected numbers of at most 3.4e38, which f32 can represent, got {largest:g}")
    return converted


def to_f64(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> F64:
    """Converts to a C-contiguous f64 array. None in `shape` permits any length.

    Raises:
        ValueError: The array has another shape.
    """
    given = _real_array(name, values)
    check_shape(name, given, shape)
    return np.ascontiguousarray(given, dtype="<f8")


def vector3(name: str, values: ArrayLike) -> list[float]:
    """Converts three numbers.

    Raises:
        ValueError: There are more or fewer numbers.
    """
    return to_f64(name, values, (3,)).tolist()


def check_shape(name: str, array: NDArray[np.generic], shape: tuple[int | None, ...]) -> None:
    """Raises ValueError unless the array has the shape."""
    fits = array.ndim == len(shape) and all(
        expected in (None, given) for expected, given in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"{name}: expected shape {format_shape(shape)}, got {array.shape}")


def format_shape(shape: tuple[int | None, ...]) -> str:
    """A shape as Python prints it, with n for any length."""
    lengths = ", ".join("n" if length is None else str(length) for length in shape)
    return f"({lengths},)" if len(shape) == 1 else f"({lengths})"


def affine(name: str, transform: ArrayLike) -> F32:
    """Converts a 3x4 or a 4x4 matrix to 3x4 f32.

    Raises:
        ValueError: The matrix has another shape, or the last row of a 4x4 matrix is not 0 0 0 1.
    """
    matrix = to_f64(name, transform, np.shape(transform))
    if matrix.shape == (4, 4):
        if not np.array_equal(matrix[3], (0, 0, 0, 1)):
            raise ValueError(f"{name}: expected the last row 0 0 0 1, got {matrix[3].tolist()}")
        matrix = matrix[:3]
    if matrix.shape != (3, 4):
        raise ValueError(f"{name}: expected a matrix of shape (3, 4) or (4, 4), got {matrix.shape}")
    return to_f32(name, matrix, (3, 4))


def _real_array(name: str, values: ArrayLike) -> NDArray[np.generic]:
    try:
        array: NDArray[np.generic] = np.asarray(values)
    except ValueError as error:  # rows of different lengths
        raise ValueError(f"{name}: expected an array of real numbers: {error}") from error
    if array.dtype.kind not in "fiu" and array.size > 0:
        raise ValueError(f"{name}: expected an array of real numbers, got the type {array.dtype}")
    return array
