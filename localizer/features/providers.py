"""onnxruntime's execution providers: the first of TensorRT, CUDA and CPU that runs a model."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import onnxruntime as ort

from localizer.caches import cache_folder
from localizer.errors import ModelError

logger = logging.getLogger(__name__)

_TENSORRT, _CUDA, _CPU = (f"{n}ExecutionProvider" for n in ("Tensorrt", "CUDA", "CPU"))
SHORT_NAMES = {_TENSORRT: "TensorRT", _CUDA: "CUDA", _CPU: "CPU"}

Provider = str | tuple[str, dict[str, str]]


@dataclass(frozen=True)
class Expected:
    """What a session is to run: images of width x height pixels with sides divisible by `multiple`,
    in float16 where TensorRT computes; sha256: of the model.
    """

    width: int
    height: int
    multiple: int
    half: bool
    sha256: str


def start_session(
    model: Path,
    options: ort.SessionOptions,
    expected: Expected,
    check: Callable[[ort.InferenceSession], None],
    only: str | None = None,
) -> ort.InferenceSession:
    """A session on the best installed provider that starts and passes `check`, which runs the model
    once: engines are built and algorithms chosen there, not at the first frame.

    only: short name of the provider to use instead of the best. Each provider that does not run the
    model is one warning. Raises `ModelError` when none does.
    """
    available = ort.get_available_providers()
    names = [name for name in (_TENSORRT, _CUDA, _CPU) if name in available]
    if only is not None:
        names = [name for name in names if SHORT_NAMES[name] == only]
    for k, name in enumerate(names):
        # What a provider cannot compute goes to the ones after it.
        providers = [_configured(n, expected) for n in names[k:]]
        try:
            session = ort.InferenceSession(
                str(model), options, providers=providers, enable_fallback=False
            )
            if name != session.get_providers()[0]:
                raise RuntimeError("its libraries could not be loaded")
            check(session)
        except Exception as error:  # onnxruntime raises its own untyped exceptions
            if k + 1 == len(names):
                if isinstance(error, ModelError):
                    raise
                raise ModelError(f"{model}: onnxruntime cannot load it: {error}") from error
            logger.warning(
                "features: %s does not run %s, trying %s: %s",
                SHORT_NAMES[name], model.name, SHORT_NAMES[names[k + 1]], str(error).split("\n")[0],
            )  # fmt: skip
        else:
            return session
    raise ModelError(
        f"{model}: this onnxruntime has no {only or 'provider'} that can run it: {available}"
    )


def provider_of(session: ort.InferenceSession) -> str:
    """Short name of the provider that serves: TensorRT, CUDA or CPU."""
    name = str(session.get_providers()[0])
    return SHORT_NAMES.get(name, name.removesuffix("ExecutionProvider"))


def _configured(name: str, expected: Expected) -> Provider:
    if name != _TENSORRT:
        return name
    folder = cache_folder("tensorrt")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:  # then it builds its engine, a minute or more, at every start
        logger.warning("features: TensorRT's engine is not kept: %s", error)
    side = 4 * expected.multiple

    def shape(height: int, width: int) -> str:
        return f"image:1x{height}x{width}x3"

    kind = "float16" if expected.half else "float32"
    height, width = max(expected.height, side), max(expected.width, side)
    return name, {
        "trt_engine_cache_enable": "True",
        "trt_engine_cache_path": str(folder),
        # Engines of other weights, sizes or precision must not be taken for this one's.
        "trt_engine_cache_prefix": f"{expected.sha256[:16]}-{width}x{height}-{kind}",
        "trt_timing_cache_enable": "True",
        "trt_timing_cache_path": str(folder),
        "trt_fp16_enable": str(expected.half),
        "trt_profile_min_shapes": shape(side, side),
        "trt_profile_opt_shapes": shape(height, width),
        "trt_profile_max_shapes": shape(2 * height, 2 * width),
    }
