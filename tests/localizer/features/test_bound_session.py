"""I/O binding, with outputs in the CPU's memory: the same calls that leave them on a GPU."""

from __future__ import annotations

import numpy as np
import pytest

from localizer.device_array import DeviceArray
from localizer.errors import DeviceArrayError
from localizer.features.detail import DetailExtractor
from localizer.features.extractor import SHIPPED_MODEL, DeviceExtractor, OnnxExtractor


def content(array: DeviceArray) -> np.ndarray:
    """What lies at the address: host memory here."""
    count = int(np.prod(array.shape))
    kind = np.ctypeslib.as_ctypes_type(array.dtype)
    return np.ctypeslib.as_array((kind * count).from_address(array.address)).reshape(array.shape)


@pytest.fixture(scope="module")
def bound():
    """The shipped network as it would be on a GPU, its outputs bound to memory of the CPU."""
    return OnnxExtractor(SHIPPED_MODEL, threads=1, only="CPU", bound_to="cpu")


def image(height, width, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_the_bound_outputs_are_those_of_a_plain_run(bound):
    for size in ((64, 96), (64, 96), (96, 64)):
        rgb = image(*size, seed=sum(size))
        plain, found = bound.extract(rgb), bound.extract_on_device(rgb)
        assert (found.width, found.height) == (plain.width, plain.height)
        for a, b in zip(plain.levels, found.levels, strict=True):
            assert isinstance(b.features, DeviceArray)
            assert b.stride == a.stride
            np.testing.assert_array_equal(content(b.features), a.features)
            np.testing.assert_array_equal(content(b.confidence), a.confidence)


def test_the_memory_is_kept_from_frame_to_frame(bound):
    addresses = [
        [level.features.address for level in bound.extract_on_device(image(64, 64, k)).levels]
        for k in range(3)
    ]
    assert addresses[0] == addresses[1] == addresses[2]


def test_the_detail_level_stays_on_the_host(bound):
    pyramid = DetailExtractor(bound).extract_on_device(image(64, 64))
    kinds = [isinstance(level.features, DeviceArray) for level in pyramid.levels]
    assert kinds == [True, True, True, False]
    assert isinstance(pyramid.levels[-1].features, np.ndarray)


def test_on_a_cpu_nothing_is_bound():
    plain = OnnxExtractor(SHIPPED_MODEL, threads=1, only="CPU")
    assert plain.provider == "CPU"
    assert isinstance(plain, DeviceExtractor)
    levels = plain.extract_on_device(image(64, 64)).levels
    assert all(isinstance(level.features, np.ndarray) for level in levels)


def test_arrays_of_other_libraries():
    class Theirs:
        def __init__(self, **changes):
            self.__cuda_array_interface__ = {
                "data": (4096, False), "shape": (2, 3), "typestr": "<f4", "strides": None,
            } | changes  # fmt: skip

    array = DeviceArray.of(Theirs())
    assert (array.address, array.shape, array.dtype) == (4096, (2, 3), np.dtype(np.float32))
    assert array.reshaped(3, 2).shape == (3, 2)
    with pytest.raises(DeviceArrayError, match="cannot be"):
        array.reshaped(4, 2)
    with pytest.raises(DeviceArrayError, match="C-contiguous"):
        DeviceArray.of(Theirs(strides=(24, 8)))
    with pytest.raises(DeviceArrayError, match="16 bytes"):
        DeviceArray.of(Theirs(data=(4100, False))).checked_address(np.float32)
