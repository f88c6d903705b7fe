"""Runs a network and keeps its outputs in device memory (onnxruntime's I/O binding)."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from localizer.device_array import DeviceArray


class BoundSession:
    """A session whose outputs are allocated once per image size and reused.

    device: onnxruntime's name of the memory, "cuda" or, in tests, "cpu". The result of `run` is
    valid until the next call.
    """

    def __init__(self, session: ort.InferenceSession, outputs: list[str], device: str) -> None:
        self._session, self._outputs, self._device = session, outputs, device
        self._binding: Any = None
        self._shape: tuple[int, ...] = ()

    def run(self, image: NDArray[np.uint8]) -> list[DeviceArray]:
        """Outputs for an (1, H, W, 3) uint8 image. The image is copied once, to the device.

        The computation is complete when this returns, so that any stream may read the outputs.
        """
        first = image.shape != self._shape
        if first:
            self._binding, self._shape = self._session.io_binding(), image.shape
            for name in self._outputs:
                self._binding.bind_output(name, self._device)
        self._binding.bind_cpu_input("image", image)
        self._session.run_with_iobinding(self._binding)
        self._binding.synchronize_outputs()
        values = self._binding.get_outputs()
        if first:  # from now on the same memory is written
            for name, value in zip(self._outputs, values, strict=True):
                self._binding.bind_ortvalue_output(name, value)
        return [_array(value) for value in values]


def _array(value: Any) -> DeviceArray:
    kind = {"tensor(float)": np.float32, "tensor(float16)": np.float16}[value.data_type()]
    return DeviceArray(value.data_ptr(), tuple(value.shape()), np.dtype(kind), value)
