"""Arrays in GPU memory, such as a network's outputs, used in place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from localizer.errors import DeviceArrayError


@dataclass(frozen=True)
class DeviceArray:
    """A C-contiguous array in device memory. owner: what keeps the memory alive."""

    address: int
    shape: tuple[int, ...]
    dtype: np.dtype
    owner: Any = None

    @classmethod
    def of(cls, other: Any) -> DeviceArray:
        """From any object with ``__cuda_array_interface__`` (CuPy, PyTorch, numba), without a copy.

        Its values must have been computed (synchronize first), because the registration's stream
        does not wait for other streams. `DeviceArrayError` if it has strides.
        """
        interface = other.__cuda_array_interface__
        if interface.get("strides") is not None:
            raise DeviceArrayError("a device array with strides: make it C-contiguous first")
        return cls(
            int(interface["data"][0]), tuple(interface["shape"]), np.dtype(interface["typestr"]),
            other,
        )  # fmt: skip

    def checked_address(self, dtype: DTypeLike) -> int:
        """The address for a kernel. `DeviceArrayError` if the array is not of `dtype` or not
        aligned to 16 bytes.
        """
        if self.dtype != np.dtype(dtype):
            raise DeviceArrayError(
                f"device features are {self.dtype}, the kernels take {np.dtype(dtype)}: export the "
                "network in that precision"
            )
        if self.address % 16:
            raise DeviceArrayError(f"device array at {self.address:#x} is not aligned to 16 bytes")
        return self.address
