"""Runs a network in Intel's OpenVINO, on processors with bfloat16 instructions.

With AMX it halves the time of onnxruntime's float32, with AVX-512 BF16 it takes two thirds of it.
On other processors it is no faster and not used.
bfloat16 changes the features by 1 % of their length; accuracy did not change measurably on real or
generated sets (docs/results/speed.md).
"""

from __future__ import annotations

import importlib.util
import sys
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

PROVIDER = "OpenVINO"
"""Its name among onnxruntime's execution providers."""

_FLAGS = {"amx_bf16", "avx512_bf16"}  # with either, as the system names them
_SIZES = 4  # whose compiled networks are kept: 15 MiB each
_CALLERS = 2  # threads that extract at a time: a frame's features and a reference's


class _Output(NamedTuple):
    name: str


class OpenVinoSession:
    """A network with the part of the interface of `onnxruntime.InferenceSession` that an extractor
    uses.

    It is compiled for each image size, because a network for any size takes twice the time. Several
    threads may call `run`. threads: number used by one call.
    """

    def __init__(self, graph: bytes, threads: int) -> None:
        # Importing it reports its use to a statistics service, on a thread of its own; without the
        # package that does so it reports nothing.
        sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
        import openvino

        self._openvino: Any = openvino
        self._core = openvino.Core()
        self._graph, self._threads = graph, threads
        self._outputs = [
            _Output(output.get_any_name()) for output in self._core.read_model(graph).outputs
        ]
        self._compiled: OrderedDict[tuple[int, ...], Any] = OrderedDict()
        self._lock = threading.Lock()
        self._mine = threading.local()

    def get_providers(self) -> list[str]:
        """The list of its own name."""
        return [PROVIDER]

    def get_outputs(self) -> list[_Output]:
        """The network's outputs, by name."""
        return self._outputs

    def run(self, outputs: list[str], inputs: dict[str, NDArray[np.uint8]]) -> list[Any]:
        """Run the network on one image (1, H, W, 3) uint8; returns the outputs in the order of
        their names `outputs`, float32. The arrays belong to the caller. Waits for the result.
        """
        (image,) = inputs.values()
        request, shapes = self._request(image.shape)
        found = {name: np.empty(shape, np.float32) for name, shape in shapes.items()}
        for name, array in found.items():  # the network writes into them: no copy
            request.set_tensor(name, self._openvino.Tensor(array, shared_memory=True))
        image = np.require(image, requirements="W")  # what OpenVINO shares
        request.set_input_tensor(self._openvino.Tensor(image, shared_memory=True))
        request.start_async()  # `infer` spends 0.2 ms on dictionaries of tensors
        request.wait()
        return [found[name] for name in outputs]

    def _request(self, shape: tuple[int, ...]) -> tuple[Any, dict[str, tuple[int, ...]]]:
        """This thread's inference request for images of a shape, and its outputs' shapes."""
        network = self._network(shape)
        if getattr(self._mine, "network", None) is not network:
            self._mine.network, self._mine.request = network, network.create_infer_request()
            self._mine.shapes = {o.get_any_name(): tuple(o.shape) for o in network.outputs}
        return self._mine.request, self._mine.shapes

    def _network(self, shape: tuple[int, ...]) -> Any:
        with self._lock:
            network = self._compiled.pop(shape, None)
            if network is None:
                network = self._compile(shape)
            self._compiled[shape] = network
            if len(self._compiled) > _SIZES:
                self._compiled.popitem(last=False)
        return network

    def _compile(self, shape: tuple[int, ...]) -> Any:
        model = self._core.read_model(self._graph)
        model.reshape(shape)
        settings = {
            "INFERENCE_PRECISION_HINT": "bf16",
            "NUM_STREAMS": _CALLERS,
            "INFERENCE_NUM_THREADS": _CALLERS * self._threads,
            "ENABLE_CPU_PINNING": False,
        }
        return self._core.compile_model(model, "CPU", settings)


def is_worthwhile(cpuinfo: Path = Path("/proc/cpuinfo")) -> bool:
    """Whether OpenVINO is installed and this processor computes in bfloat16."""
    if importlib.util.find_spec("openvino") is None:
        return False
    try:
        text = cpuinfo.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    flags = next((line for line in text.splitlines() if line.startswith("flags")), "")
    return not _FLAGS.isdisjoint(flags.split())
