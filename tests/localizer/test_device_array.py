"""Arrays in GPU memory that other libraries own."""

from __future__ import annotations

import numpy as np
import pytest

from localizer.device_array import DeviceArray
from localizer.errors import DeviceArrayError


def test_arrays_of_other_libraries():
    class Theirs:
        def __init__(self, **changes):
            self.__cuda_array_interface__ = {
                "data": (4096, False), "shape": (2, 3), "typestr": "<f4", "strides": None,
            } | changes  # fmt: skip

    array = DeviceArray.of(Theirs())
    assert (array.address, array.shape, array.dtype) == (4096, (2, 3), np.dtype(np.float32))
    with pytest.raises(DeviceArrayError, match="C-contiguous"):
        DeviceArray.of(Theirs(strides=(24, 8)))
    with pytest.raises(DeviceArrayError, match="16 bytes"):
        DeviceArray.of(Theirs(data=(4100, False))).checked_address(np.float32)
