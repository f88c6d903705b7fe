"""A thin layer over the CUDA driver: device, memory, launches, graphs and events.

Calls go through `cuda.bindings.driver`; a failed call raises `CudaError` with the driver's error
name. The device's primary context is used, so that memory of onnxruntime or PyTorch in the same
process can be read in place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from localizer.registration.cuda.errors import CudaError, CudaUnavailableError


class Device:
    """One CUDA device. Each thread must call `activate` before other calls."""

    def __init__(self, index: int = 0) -> None:
        """Raises `CudaUnavailableError` where there is no such device, no driver, no bindings."""
        self._api = _load_driver()
        self._handle = self._call(self._api.cuDeviceGet, index)
        self._context = self._call(self._api.cuDevicePrimaryCtxRetain, self._handle)
        self.activate()
        attribute = self._api.CUdevice_attribute
        self.name: str = (
            self._call(self._api.cuDeviceGetName, 256, self._handle).split(b"\0")[0].decode()
        )
        self.architecture = (
            self._attribute(attribute.CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR),
            self._attribute(attribute.CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MINOR),
        )
        self.multiprocessors = self._attribute(attribute.CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT)
        self.stream = self._call(
            self._api.cuStreamCreate, self._api.CUstream_flags.CU_STREAM_NON_BLOCKING
        )

    def activate(self) -> None:
        """Make the device's context the calling thread's."""
        self._call(self._api.cuCtxSetCurrent, self._context)

    def load(self, code: bytes) -> Kernels:
        """Load machine code; `CudaError` if it is of another architecture."""
        return Kernels(self, self._call(self._api.cuModuleLoadData, code))

    def allocate(self, size: int) -> int:
        """Address of `size` bytes of device memory (at least 1), until the caller calls `free`."""
        return int(self._call(self._api.cuMemAlloc, max(size, 1)))

    def free(self, address: int) -> None:
        """Free memory of `allocate`."""
        self._call(self._api.cuMemFree, address)

    def upload(self, address: int, array: NDArray[Any]) -> None:
        """Queue a copy of a C-contiguous array to the device; ValueError for another layout. The
        array may be changed at once.
        """
        if not array.flags.c_contiguous:
            raise ValueError("only C-contiguous arrays can be copied to the device")
        self._call(
            self._api.cuMemcpyHtoDAsync, address, array.ctypes.data, array.nbytes, self.stream
        )

    def download(self, array: NDArray[Any], address: int) -> None:
        """Queue a copy from the device into a C-contiguous array; valid after `synchronize`."""
        self._call(
            self._api.cuMemcpyDtoHAsync, array.ctypes.data, address, array.nbytes, self.stream
        )

    def copy(self, target: int, source: int, size: int) -> None:
        """Queue a copy within the device."""
        self._call(self._api.cuMemcpyDtoDAsync, target, source, size, self.stream)

    def synchronize(self) -> None:
        """Wait for all queued work; kernel errors are raised here."""
        self._call(self._api.cuStreamSynchronize, self.stream)

    def capture(self, enqueue: Callable[[], None]) -> Graph:
        """Capture the work that `enqueue` queues as a graph, without running it. Its kernels must
        be loaded before (`Kernels.load_all`).
        """
        mode = self._api.CUstreamCaptureMode.CU_STREAM_CAPTURE_MODE_THREAD_LOCAL
        self._call(self._api.cuStreamBeginCapture, self.stream, mode)
        try:
            enqueue()
        finally:
            graph = self._call(self._api.cuStreamEndCapture, self.stream)
        try:
            return Graph(self, self._call(self._api.cuGraphInstantiate, graph, 0))
        finally:
            self._call(self._api.cuGraphDestroy, graph)

    def event(self) -> Any:
        """Record a marker in the stream now, for `elapsed_ms`. It is never freed, so use it for
        measurements only.
        """
        event = self._call(self._api.cuEventCreate, 0)
        self._call(self._api.cuEventRecord, event, self.stream)
        return event

    def elapsed_ms(self, start: Any, stop: Any) -> float:
        """Milliseconds of device time from `start` to `stop`, of `event`; waits for `stop`."""
        self._call(self._api.cuEventSynchronize, stop)
        return float(self._call(self._api.cuEventElapsedTime, start, stop))

    def _attribute(self, attribute: Any) -> int:
        return int(self._call(self._api.cuDeviceGetAttribute, attribute, self._handle))

    def _call(self, function: Callable[..., tuple[Any, ...]], *arguments: Any) -> Any:
        status, *values = function(*arguments)
        if status != self._api.CUresult.CUDA_SUCCESS:
            raise CudaError(f"{function.__name__} failed: {status.name}")
        return values[0] if values else None


class Kernels:
    """The functions of a loaded image."""

    def __init__(self, device: Device, module: Any) -> None:
        self._device, self._module = device, module
        self._functions: dict[str, Any] = {}

    def launch(self, name: str, blocks: int, threads: int, arguments: NDArray[Any]) -> None:
        """Queue a kernel whose only parameter is a structure; arguments: 0-d structured array."""
        # The driver copies the structure before it returns.
        pointers = np.array([arguments.ctypes.data], dtype=np.uint64)
        self._device._call(
            self._device._api.cuLaunchKernel, self._function(name), blocks, 1, 1, threads, 1, 1, 0,
            self._device.stream, pointers.ctypes.data, 0,
        )  # fmt: skip

    def load_all(self, names: Iterable[str]) -> None:
        """Look the functions up now: some drivers load them lazily, which a capture forbids."""
        for name in names:
            self._function(name)

    def resources(self, name: str) -> dict[str, int]:
        """Registers per thread, shared and local bytes of a kernel, as the driver reports them."""
        attribute = self._device._api.CUfunction_attribute
        wanted = {
            "registers": attribute.CU_FUNC_ATTRIBUTE_NUM_REGS,
            "shared": attribute.CU_FUNC_ATTRIBUTE_SHARED_SIZE_BYTES,
            "local": attribute.CU_FUNC_ATTRIBUTE_LOCAL_SIZE_BYTES,
        }
        call, api = self._device._call, self._device._api
        return {
            key: int(call(api.cuFuncGetAttribute, which, self._function(name)))
            for key, which in wanted.items()
        }

    def _function(self, name: str) -> Any:
        if name not in self._functions:
            self._functions[name] = self._device._call(
                self._device._api.cuModuleGetFunction, self._module, name.encode()
            )
        return self._functions[name]


class Graph:
    """An instantiated graph."""

    def __init__(self, device: Device, handle: Any) -> None:
        self._device, self._handle = device, handle

    def launch(self) -> None:
        """Queue the whole graph."""
        self._device._call(self._device._api.cuGraphLaunch, self._handle, self._device.stream)

    def destroy(self) -> None:
        """Free the graph's memory."""
        self._device._call(self._device._api.cuGraphExecDestroy, self._handle)


class Arena:
    """Named device buffers that are reused, so that a frame allocates no memory. generation: number
    of allocations so far; graphs captured with an older one hold wrong addresses.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self._buffers: dict[str, tuple[int, int]] = {}
        self.generation = 0  # changes when any address has changed

    def buffer(self, name: str, size: int) -> int:
        """Device address of buffer `name`, at least `size` bytes; enlarging it loses its content
        and changes the address.
        """
        address, have = self._buffers.get(name, (0, 0))
        if address and have >= size:
            return address
        if address:
            self._device.synchronize()
            self._device.free(address)
        self._buffers[name] = (self._device.allocate(size), size)
        self.generation += 1
        return self._buffers[name][0]

    def put(self, name: str, array: NDArray[Any]) -> int:
        """Copy a C-contiguous array to the buffer `name`; returns its device address."""
        address = self.buffer(name, array.nbytes)
        self._device.upload(address, array)
        return address

    @property
    def size(self) -> int:
        """Bytes of device memory in all buffers."""
        return sum(size for _, size in self._buffers.values())

    def close(self) -> None:
        """Free all buffers."""
        self._device.synchronize()
        for address, _ in self._buffers.values():
            self._device.free(address)
        self._buffers.clear()


def _load_driver() -> ModuleType:
    """The bindings with a started driver and at least one device, or `CudaUnavailableError`."""
    try:
        from cuda.bindings import driver
    except ImportError as error:
        raise CudaUnavailableError(
            f"no CUDA bindings ({error}): install the extra `gpu`"
        ) from error
    try:
        status = driver.cuInit(0)[0]
    except RuntimeError as error:  # the bindings' own error for a library that is not there
        raise CudaUnavailableError("no NVIDIA driver (libcuda) on this machine") from error
    if status == driver.CUresult.CUDA_ERROR_NO_DEVICE:
        raise CudaUnavailableError("the NVIDIA driver sees no GPU")
    if status != driver.CUresult.CUDA_SUCCESS:
        raise CudaUnavailableError(f"the NVIDIA driver does not start: {status.name}")
    status, count = driver.cuDeviceGetCount()
    if status != driver.CUresult.CUDA_SUCCESS or count == 0:
        raise CudaUnavailableError("the NVIDIA driver sees no GPU")
    api: ModuleType = driver
    return api
