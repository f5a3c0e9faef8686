"""Calls of the CUDA driver, with which memory of a server on the same machine is imported."""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Generator
from functools import cache
from typing import Any

from modalcast.errors import Unavailable

_POSIX_FILE_DESCRIPTOR = 1
_DEVICE_LOCATION = 1
_READ_AND_WRITE = 3


class _Access(ctypes.Structure):
    """`CUmemAccessDesc`."""

    _fields_ = (("location_type", ctypes.c_int), ("location_id", ctypes.c_int), ("flags", ctypes.c_int))


@cache
def _library() -> ctypes.CDLL:
    """The driver.

    Raises:
        Unavailable: There is no driver, or it finds no device.
    """
    try:
        library = ctypes.CDLL("libcuda.so.1")
    except OSError as error:
        raise Unavailable(f"device='cuda': no CUDA driver on this machine: {error}") from None
    _check(library, "cuInit", ctypes.c_uint(0))
    return library


def _check(library: ctypes.CDLL, name: str, *arguments: Any) -> None:
    """Calls a function of the driver.

    Raises:
        Unavailable: The call failed.
    """
    code = getattr(library, name)(*arguments)
    if code != 0:
        text = ctypes.c_char_p()
        library.cuGetErrorName(code, ctypes.byref(text))
        reason = text.value.decode() if text.value else f"error {code}"
        raise Unavailable(f"device='cuda': {name}: {reason}")


def _call(name: str, *arguments: Any) -> None:
    _check(_library(), name, *arguments)


class CudaDevice:
    """A device, with the context that other libraries of this process use, too (the primary context).

    Attributes:
        ordinal: The index of the device in this process.
    """

    def __init__(self, uuid: bytes) -> None:
        """Finds the device with a UUID.

        Raises:
            Unavailable: This process does not see the device.
        """
        count = ctypes.c_int()
        _call("cuDeviceGetCount", ctypes.byref(count))
        uuids = [_uuid_of(ordinal) for ordinal in range(count.value)]
        if uuid not in uuids:
            others = ", ".join(other.hex() for other in uuids) or "none"
            expected = f"the GPU of the server, {uuid.hex()}, among those of this process"
            raise Unavailable(f"device='cuda': expected {expected}, got {others}")
        self.ordinal = uuids.index(uuid)
        device = ctypes.c_int()
        _call("cuDeviceGet", ctypes.byref(device), ctypes.c_int(self.ordinal))
        self._context = ctypes.c_void_p()
        _call("cuDevicePrimaryCtxRetain", ctypes.byref(self._context), device)

    @contextlib.contextmanager
    def current(self) -> Generator[None]:
        """Makes the context current on this thread."""
        _call("cuCtxPushCurrent_v2", self._context)
        try:
            yield
        finally:
            previous = ctypes.c_void_p()
            _call("cuCtxPopCurrent_v2", ctypes.byref(previous))

    def synchronize(self) -> None:
        """Waits for all work of this process on the device."""
        with self.current():
            _call("cuCtxSynchronize")


def _uuid_of(ordinal: int) -> bytes:
    device = ctypes.c_int()
    uuid = (ctypes.c_ubyte * 16)()
    _call("cuDeviceGet", ctypes.byref(device), ctypes.c_int(ordinal))
    _call("cuDeviceGetUuid_v2", ctypes.byref(uuid), device)
    return bytes(uuid)


class ImportedMemory:
    """Memory of another process on a device, mapped at an address of this process until this is closed or deleted.

    Attributes:
        address: The device address of the first byte.
    """

    def __init__(self, device: CudaDevice, file: int, length: int) -> None:
        """Imports the allocation behind a file descriptor, which remains open.

        Raises:
            Unavailable: The driver cannot import it.
        """
        self._device = device
        self._length = ctypes.c_size_t(length)
        self._handle = ctypes.c_ulonglong()
        self._address = ctypes.c_ulonglong()
        self._is_mapped = False
        try:
            with device.current():
                self._map(file)
        except BaseException:
            self.close()
            raise
        self.address = self._address.value

    def _map(self, file: int) -> None:
        _call(
            "cuMemImportFromShareableHandle",
            ctypes.byref(self._handle),
            ctypes.c_void_p(file),
            ctypes.c_int(_POSIX_FILE_DESCRIPTOR),
        )
        zero = ctypes.c_size_t(0)
        flags = ctypes.c_ulonglong(0)
        _call("cuMemAddressReserve", ctypes.byref(self._address), self._length, zero, flags, flags)
        _call("cuMemMap", self._address, self._length, zero, self._handle, flags)
        self._is_mapped = True
        access = _Access(_DEVICE_LOCATION, self._device.ordinal, _READ_AND_WRITE)
        _call("cuMemSetAccess", self._address, self._length, ctypes.byref(access), ctypes.c_size_t(1))

    def close(self) -> None:
        """Ends the mapping, after all work of this process on the device. The memory remains that of the server."""
        # There is nothing else to do after an error: the process ends, or the device has failed.
        with contextlib.suppress(Unavailable), self._device.current():
            if self._is_mapped:
                _call("cuCtxSynchronize")
                _call("cuMemUnmap", self._address, self._length)
            if self._address.value != 0:
                _call("cuMemAddressFree", self._address, self._length)
            if self._handle.value != 0:
                _call("cuMemRelease", self._handle)
        self._is_mapped = False
        self._address.value = self._handle.value = 0

    def __del__(self) -> None:
        self.close()
