"""Arrays in memory of the GPU that the server owns, for libraries that accept DLPack, such as torch, cupy and jax."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

# DLPack: https://dmlc.github.io/dlpack/latest/c_api.html
_CUDA = 2
_TYPE_CODES = {"i": 0, "u": 1, "f": 2}


class _DataType(ctypes.Structure):
    """`DLDataType`."""

    _fields_ = (("code", ctypes.c_uint8), ("bits", ctypes.c_uint8), ("lanes", ctypes.c_uint16))


class _Tensor(ctypes.Structure):
    """`DLTensor`."""

    _fields_ = (
        ("data", ctypes.c_void_p),
        ("device_type", ctypes.c_int),
        ("device_id", ctypes.c_int),
        ("ndim", ctypes.c_int),
        ("dtype", _DataType),
        ("shape", ctypes.POINTER(ctypes.c_int64)),
        ("strides", ctypes.POINTER(ctypes.c_int64)),
        ("byte_offset", ctypes.c_uint64),
    )


class _ManagedTensor(ctypes.Structure):
    """`DLManagedTensor`."""


_Deleter = ctypes.CFUNCTYPE(None, ctypes.POINTER(_ManagedTensor))
_ManagedTensor._fields_ = (  # pyright: ignore[reportPrivateUsage] # the type refers to itself
    ("tensor", _Tensor),
    ("context", ctypes.c_void_p),
    ("deleter", _Deleter),
)

# The tensors whose consumers have not deleted them, with all objects that they refer to, by address.
_exported: dict[int, tuple[object, ...]] = {}


@_Deleter
def _delete(managed: Any) -> None:
    _exported.pop(ctypes.addressof(managed.contents), None)


@ctypes.CFUNCTYPE(None, ctypes.c_void_p)
def _delete_capsule(capsule: int) -> None:
    """Deletes the tensor of a capsule that nobody has consumed: a consumer changes the name."""
    if _is_valid(capsule, b"dltensor"):
        _exported.pop(_pointer_of(capsule, b"dltensor"), None)


# At the end of the process, tensors may exist longer than this module. They still call these functions.
for _object in (_exported, _delete, _delete_capsule):
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(_object))

_new_capsule = ctypes.pythonapi.PyCapsule_New
_new_capsule.restype = ctypes.py_object
_new_capsule.argtypes = (ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p)
_is_valid = ctypes.pythonapi.PyCapsule_IsValid
_is_valid.restype = ctypes.c_int
_is_valid.argtypes = (ctypes.c_void_p, ctypes.c_char_p)
_pointer_of = ctypes.pythonapi.PyCapsule_GetPointer
_pointer_of.restype = ctypes.c_void_p
_pointer_of.argtypes = (ctypes.c_void_p, ctypes.c_char_p)


class DeviceArray:
    """A C-contiguous array on the GPU, complete when the caller gets it. `torch.from_dlpack(array)` is a tensor of it.

    The memory belongs to the server, which writes the pictures of a later step there when this array, and all tensors
    made from it, no longer exist.

    Attributes:
        shape: The shape.
        dtype: The type.
        address: The device address of the first number.
        device: The index of the device in this process.
    """

    def __init__(self, lease: object, address: int, shape: tuple[int, ...], dtype: np.dtype[Any], device: int) -> None:
        """`lease` is referenced as long as the memory is in use."""
        self._lease = lease
        self.address = address
        self.shape = shape
        self.dtype = dtype
        self.device = device

    @property
    def __cuda_array_interface__(self) -> dict[str, Any]:
        return {
            "shape": self.shape,
            "typestr": self.dtype.str,
            "data": (self.address, False),
            "strides": None,
            "version": 3,
        }

    def __dlpack_device__(self) -> tuple[int, int]:
        return (_CUDA, self.device)

    def __dlpack__(self, *, stream: Any = None, dl_device: Any = None, copy: bool | None = None, **_: Any) -> object:
        """A capsule for consumers of DLPack. No stream has to wait, because the pictures are complete.

        Raises:
            BufferError: The consumer asks for a copy, or for another device.
        """
        if copy or dl_device not in (None, self.__dlpack_device__()):
            raise BufferError(f"expected no copy and device {self.__dlpack_device__()}, got {copy} and {dl_device}")
        shape = (ctypes.c_int64 * len(self.shape))(*self.shape)
        data_type = _DataType(_TYPE_CODES[self.dtype.kind], 8 * self.dtype.itemsize, 1)
        tensor = _Tensor(self.address, _CUDA, self.device, len(self.shape), data_type, shape, None, 0)
        managed = _ManagedTensor(tensor, None, _delete)
        address = ctypes.addressof(managed)
        _exported[address] = (managed, shape, self)
        return _new_capsule(address, b"dltensor", ctypes.cast(_delete_capsule, ctypes.c_void_p))

    def __repr__(self) -> str:
        return f"<DeviceArray {self.shape} of {self.dtype} on device {self.device}>"
