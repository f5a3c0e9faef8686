"""Types of arrays, and conversions that state the expected and the given shape in their errors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Bytes: TypeAlias = NDArray[np.uint8]
F32: TypeAlias = NDArray[np.float32]
F64: TypeAlias = NDArray[np.float64]
U32: TypeAlias = NDArray[np.uint32]
Indices: TypeAlias = NDArray[np.intp]

Rows: TypeAlias = NDArray[Any]
"""Arrays of f32, or of structures with the layout of the wire."""

Vector: TypeAlias = Sequence[float] | F64 | F32
"""Three numbers."""


def to_f32(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> F32:
    """Converts to a C-contiguous f32 array. None in `shape` permits any length.

    Raises:
        ValueError: The array has another shape, or a number exceeds the range of f32.
    """
    given = real_array(name, values)
    check_shape(name, given, shape)
    with np.errstate(over="ignore"):
        converted = np.ascontiguousarray(given, dtype="<f4")
    is_rounded = converted.dtype != given.dtype and not np.isfinite(converted).all()
    if is_rounded and np.isinf(converted).sum() != np.isinf(given).sum():
        largest = float(np.abs(given).max())
        raise ValueError(f"{name}: expected numbers of at most 3.4e38, which f32 can represent, got {largest:g}")
    return converted


def to_f64(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> F64:
    """Converts to a C-contiguous f64 array. None in `shape` permits any length.

    Raises:
        ValueError: The array has another shape.
    """
    given = real_array(name, values)
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


def affine(name: str, transforms: ArrayLike, leading: tuple[int, ...] = ()) -> F32:
    """Converts 3x4 or 4x4 matrices, in an array with the `leading` dimensions before these, to 3x4 f32.

    Raises:
        ValueError: The array has another shape, or the last row of a 4x4 matrix is not 0 0 0 1.
    """
    matrices = real_array(name, transforms)
    square_shape, shape = (*leading, 4, 4), (*leading, 3, 4)
    if matrices.shape == square_shape:
        last_rows = matrices[..., 3, :]
        if not (last_rows == (0, 0, 0, 1)).all():
            wrong = last_rows[(last_rows != (0, 0, 0, 1)).any(axis=-1)].reshape(-1, 4)[0]
            raise ValueError(f"{name}: expected the last row 0 0 0 1, got {wrong.tolist()}")
        matrices = matrices[..., :3, :]
    if matrices.shape != shape:
        kind = "an array" if leading else "a matrix"
        raise ValueError(f"{name}: expected {kind} of shape {shape} or {square_shape}, got {matrices.shape}")
    return to_f32(name, matrices, shape)


def real_array(name: str, values: ArrayLike) -> NDArray[np.generic]:
    """Converts to an array of real numbers of any type and shape.

    Raises:
        ValueError: The values are no such array.
    """
    try:
        array: NDArray[np.generic] = np.asarray(values)
    except ValueError as error:  # rows of different lengths
        raise ValueError(f"{name}: expected an array of real numbers: {error}") from error
    if array.dtype.kind not in "fiu" and array.size > 0:
        raise ValueError(f"{name}: expected an array of real numbers, got the type {array.dtype}")
    return array
