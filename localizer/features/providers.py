"""Selects what runs a model: the first of TensorRT, CUDA, OpenVINO and CPU that works.

All but OpenVINO are onnxruntime's execution providers.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from localizer.caches import cache_folder
from localizer.errors import ModelError
from localizer.features.openvino_session import PROVIDER as _OPENVINO
from localizer.features.openvino_session import OpenVinoSession, is_worthwhile

_log = logging.getLogger(__name__)

_TENSORRT, _CUDA, _CPU = (f"{n}ExecutionProvider" for n in ("Tensorrt", "CUDA", "CPU"))
SHORT_NAMES = {_TENSORRT: "TensorRT", _CUDA: "CUDA", _OPENVINO: _OPENVINO, _CPU: "CPU"}

Provider = str | tuple[str, dict[str, str]]


class Session(Protocol):
    """A loaded network: onnxruntime's or OpenVINO's."""

    def run(self, outputs: list[str], inputs: dict[str, NDArray[np.uint8]], /) -> list[Any]:
        """The named outputs."""

    def get_outputs(self) -> Sequence[Any]:
        """All outputs, each with its name."""

    def get_providers(self) -> list[str]:
        """Full names of the execution providers, by priority."""


@dataclass(frozen=True)
class Expected:
    """The session's input: image size with sides divisible by `multiple`; half: float16 in
    TensorRT; sha256: of the graph.
    """

    width: int
    height: int
    multiple: int
    half: bool
    sha256: str


def start_session(
    model: Path,
    graph: bytes,
    options: ort.SessionOptions,
    expected: Expected,
    check: Callable[[Session], None],
    only: str | None = None,
) -> Session:
    """Start a session on the best installed provider that works. check: runs the model once, so
    that engines are built and algorithms chosen before the first frame.

    model: names the graph in messages. only: short name of the only provider to use. A provider
    that cannot run the model is reported by one warning. TensorRT is tried a second time without
    its cached engines, which may be damaged. Raises `ModelError` if no provider works.
    """
    available = available_providers()
    names = [name for name in SHORT_NAMES if name in available]
    if only is not None:
        names = [name for name in names if SHORT_NAMES[name] == only]
    for k, name in enumerate(names):
        kept = _kept(expected) if name == _TENSORRT else []
        try:
            try:
                return _started(graph, options, expected, names[k:], check)
            except Exception as error:
                if not _removed(kept):
                    raise
                _log.warning("features: TensorRT builds its engine again: %s", _line(error))
                return _started(graph, options, expected, names[k:], check)
        except Exception as error:  # onnxruntime raises its own untyped exceptions
            if k + 1 == len(names):
                if isinstance(error, ModelError):
                    raise
                raise ModelError(f"{model}: onnxruntime cannot load it: {error}") from error
            _log.warning(
                "features: %s does not run %s, trying %s: %s",
                SHORT_NAMES[name], model.name, SHORT_NAMES[names[k + 1]], _line(error),
            )  # fmt: skip
    raise ModelError(
        f"{model}: this onnxruntime has no {only or 'provider'} that can run it: {available}"
    )


def available_providers() -> list[str]:
    """Full names of the providers that this onnxruntime was built with, whether or not they start
    here, and OpenVINO if `is_worthwhile`. Loads CUDA's packages.
    """
    names = ort.get_available_providers()
    if _CUDA in names:
        load_cuda_packages()
    return [*names, *([_OPENVINO] if is_worthwhile() else [])]


@functools.cache
def load_cuda_packages() -> None:
    """Load CUDA and cuDNN from Python packages, where onnxruntime does not look by itself."""
    with contextlib.redirect_stdout(io.StringIO()) as told:
        ort.preload_dlls(directory="")
    _log.debug("features: %s", told.getvalue())


def _started(
    graph: bytes,
    options: ort.SessionOptions,
    expected: Expected,
    names: list[str],
    check: Callable[[Session], None],
) -> Session:
    """A session on the first provider; later providers run what it cannot compute."""
    if names[0] == _OPENVINO:
        alone = OpenVinoSession(graph, options.intra_op_num_threads)
        check(alone)
        return alone
    providers = [_configured(n, expected) for n in names if n != _OPENVINO]
    session: Session = ort.InferenceSession(
        graph, options, providers=providers, enable_fallback=False
    )
    if names[0] != session.get_providers()[0]:
        raise RuntimeError("its libraries could not be loaded")
    check(session)
    return session


def _line(error: Exception) -> str:
    return str(error).split("\n")[0]


def provider_of(session: Session) -> str:
    """Short name of a session's provider: TensorRT, CUDA, OpenVINO or CPU."""
    name = str(session.get_providers()[0])
    return SHORT_NAMES.get(name, name.removesuffix("ExecutionProvider"))


def _prefix(expected: Expected) -> str:
    """File name prefix of cached engines; it differs for other weights, sizes and precisions."""
    kind = "float16" if expected.half else "float32"
    height, width = _sides(expected)
    return f"{expected.sha256[:16]}-{width}x{height}-{kind}"


def _sides(expected: Expected) -> tuple[int, int]:
    side = 4 * expected.multiple
    return max(expected.height, side), max(expected.width, side)


def _kept(expected: Expected) -> list[Path]:
    """TensorRT's cached engines and timings of this model."""
    folder = cache_folder("tensorrt")
    try:
        return sorted([*folder.glob(f"{_prefix(expected)}*"), *folder.glob("*.timing")])
    except OSError:
        return []


def _removed(files: list[Path]) -> bool:
    """Remove cached files; returns whether one could be removed."""
    removed = False
    for file in files:
        with contextlib.suppress(OSError):
            file.unlink()
            removed = True
    return removed


def _kept_in(expected: Expected) -> dict[str, str]:
    """Options that make TensorRT cache the engine. Empty, with a warning, if the folder is not
    writable: the engine is then built at every start, for a minute or more.
    """
    folder = cache_folder("tensorrt")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, "may not be written", str(folder))
    except OSError as error:
        _log.warning("features: TensorRT's engine is not kept: %s", error)
        return {}
    return {
        "trt_engine_cache_enable": "True",
        "trt_engine_cache_path": str(folder),
        "trt_engine_cache_prefix": _prefix(expected),
        "trt_timing_cache_enable": "True",
        "trt_timing_cache_path": str(folder),
    }


def _configured(name: str, expected: Expected) -> Provider:
    if name != _TENSORRT:
        return name
    side = 4 * expected.multiple
    height, width = _sides(expected)

    def shape(height: int, width: int) -> str:
        return f"image:1x{height}x{width}x3"

    return name, {
        **_kept_in(expected),
        "trt_fp16_enable": str(expected.half),
        "trt_profile_min_shapes": shape(side, side),
        "trt_profile_opt_shapes": shape(height, width),
        "trt_profile_max_shapes": shape(2 * height, 2 * width),
    }
