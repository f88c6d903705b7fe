"""Feature extractors: a network in onnxruntime or OpenVINO, or gradient features as a fallback.

A model is two files: ``NAME.onnx`` and ``NAME.json``. The graph takes ``image`` (1, H, W, 3) uint8
RGB with H and W divisible by the description's `multiple`. For each level, coarse to fine, it gives
``features_K`` (1, h, w, C) float32 of unit length per pixel and ``confidence_K`` (1, h, w) float32
in (0, 1). The JSON file names the levels and has the SHA-256 of the graph. If `orientation` is true
there, the graph gives ``learned_K`` (1, h, w, C - 7) float32 instead, from which
`orientation_level` makes both.
"""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path
from typing import Protocol

import numpy as np
import onnxruntime as ort
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from localizer.errors import ModelError
from localizer.features.gradient import GradientExtractor
from localizer.features.image import check_image
from localizer.features.openvino_session import PROVIDER as OPENVINO
from localizer.features.orientation import gray_of, orientation_level
from localizer.features.providers import Expected, Session, provider_of, start_session
from localizer.features.subgraph import cut_to_outputs
from localizer.plain_files import plain_bytes, plain_text
from localizer.types import FeatureLevel, FeaturePyramid, Image

_log = logging.getLogger(__name__)

SHIPPED_MODEL = Path(__file__).parent / "weights" / "tiny.onnx"
_MOST_BYTES = 1 << 30


class FeatureExtractor(Protocol):
    """Computes the feature pyramid of an image (paper, Sec. 3.3.1)."""

    @property
    def name(self) -> str:
        """Network and what runs it, for reports, e.g. ``tiny (onnxruntime, CPU)``."""

    def extract(self, rgb: Image) -> FeaturePyramid:
        """Pyramid of an (H, W, 3) uint8 RGB image, H and W divisible by 8 (`ModelError` otherwise).
        Several threads may call it at a time.
        """


class LevelInfo(BaseModel):
    """One pyramid level of a model: image pixels per feature pixel, and feature channels."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    stride: int = Field(gt=0)
    channels: int = Field(gt=0)


class ModelInfo(BaseModel):
    """Content of the JSON file beside a model. multiple: what image sides must be divisible by;
    orientation: whether the graph lacks the channels that nobody learned.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
    name: str
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    levels: tuple[LevelInfo, ...] = Field(min_length=1)
    parameters: int = Field(gt=0)
    multiple: int = Field(default=8, gt=0, le=64)
    orientation: bool = False
    training: dict[str, object] = {}

    @model_validator(mode="after")
    def _is_a_pyramid(self) -> ModelInfo:
        strides = [level.stride for level in self.levels]
        if strides != sorted(set(strides), reverse=True):
            raise ValueError(f"levels must go from coarse to fine, got strides {strides}")
        if any(self.multiple % stride for stride in strides):
            raise ValueError(f"multiple {self.multiple} is not divisible by the strides {strides}")
        return self


def read_model_info(model: Path) -> ModelInfo:
    """Metadata of `model`, with the graph's hash verified against it. `ModelError` if a file cannot
    be read, the description is not valid, or the hash differs.
    """
    path = model.with_suffix(".json")
    try:
        info = ModelInfo.model_validate_json(plain_text(path))
    except OSError as error:
        raise ModelError(
            f"{path}: cannot be read ({error.strerror}); every model needs its JSON file beside it"
        ) from error
    except ValidationError as error:
        wrong = [f"{'.'.join(map(str, e['loc'])) or 'all'}: {e['msg']}" for e in error.errors()]
        raise ModelError(f"{path}: not a valid model description: {'; '.join(wrong)}") from error
    except ValueError as error:  # no UTF-8
        raise ModelError(f"{path}: not a valid model description: {error}") from error
    try:
        digest = hashlib.sha256(plain_bytes(model, _MOST_BYTES)).hexdigest()
    except OSError as error:
        raise ModelError(f"{model}: cannot be read: {error.strerror}") from error
    if digest != info.sha256:
        raise ModelError(
            f"{model}: SHA-256 is {digest}, {path.name} says {info.sha256}; the file is corrupt or "
            "of another version: fetch both files again"
        )
    return info


class OnnxExtractor:
    """A network in onnxruntime, on the best execution provider that works.

    size: width and height of the images to come, for the warm-up. half: TensorRT may compute in
    float16. only: TensorRT, CUDA or CPU, instead of the best. finest: levels of a smaller stride
    are not computed.
    """

    def __init__(
        self,
        model: Path,
        *,
        threads: int = 2,
        size: tuple[int, int] | None = None,
        half: bool = False,
        only: str | None = None,
        finest: int = 1,
    ) -> None:
        self.info = read_model_info(model)
        self._levels = tuple(level for level in self.info.levels if level.stride >= finest)
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        # Spinning worker threads would starve the optimizer and the renderer on a small computer.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self._multiple = self.info.multiple
        kinds = ("learned",) if self.info.orientation else ("features", "confidence")
        self._outputs = [f"{kind}_{k}" for k in range(len(self._levels)) for kind in kinds]
        width, height = size or (4 * self._multiple, 4 * self._multiple)
        graph = plain_bytes(model, _MOST_BYTES)
        if self._levels != self.info.levels:
            graph = cut_to_outputs(graph, self._outputs)
        expected = Expected(
            width, height, self._multiple, half, hashlib.sha256(graph).hexdigest()
        )  # fmt: skip
        self._session = start_session(
            model,
            graph,
            options,
            expected,
            lambda session: self._check(session, model, width, height),
            only,
        )
        _log.info("features: %s", self.name)

    @property
    def provider(self) -> str:
        """Short name of the execution provider in use: TensorRT, CUDA, OpenVINO or CPU."""
        return provider_of(self._session)

    @property
    def name(self) -> str:
        """Model and provider, for reports."""
        if self.provider == OPENVINO:
            return f"{self.info.name} (OpenVINO, CPU, bfloat16)"
        return f"{self.info.name} (onnxruntime, {self.provider})"

    def extract(self, rgb: Image) -> FeaturePyramid:
        """Pyramid of an (H, W, 3) uint8 RGB image, H and W divisible by `info.multiple`."""
        check_image(rgb, self._multiple)
        return FeaturePyramid(self._run(self._session, rgb), rgb.shape[1], rgb.shape[0])

    def _run(self, session: Session, rgb: Image) -> tuple[FeatureLevel, ...]:
        rgb = np.ascontiguousarray(rgb)
        arrays = session.run(self._outputs, {"image": rgb[None]})
        if self.info.orientation:
            gray = gray_of(rgb)
            return tuple(
                orientation_level(gray, level.stride, learned[0])
                for level, learned in zip(self._levels, arrays, strict=True)
            )
        return tuple(
            FeatureLevel(arrays[2 * k][0], arrays[2 * k + 1][0], level.stride)
            for k, level in enumerate(self._levels)
        )

    def _check(self, session: Session, model: Path, width: int, height: int) -> None:
        """Run the network once, to warm it up and to detect a wrong graph now, not in flight."""
        try:
            levels = self._run(session, np.zeros((height, width, 3), np.uint8))
        except Exception as error:
            raise ModelError(
                f"{model}: does not run on a {width}x{height} image: {error}"
            ) from error
        given = len(session.get_outputs())
        if given != len(self._outputs):
            raise ModelError(
                f"{model}: the graph has {given} outputs, its description names "
                f"{len(self._levels)} levels of features and confidence"
            )
        for level, expected in zip(levels, self._levels, strict=True):
            shape = (height // expected.stride, width // expected.stride, expected.channels)
            if level.features.shape != shape or level.confidence.shape != shape[:2]:
                raise ModelError(
                    f"{model}: level of stride {expected.stride} gives {level.features.shape}, "
                    f"its description says {shape}"
                )
            for values in (level.features, level.confidence):
                if values.dtype != np.float32 or not np.isfinite(values).all():
                    raise ModelError(
                        f"{model}: level of stride {expected.stride} gives {values.dtype} or "
                        "values that are not finite: export it again, from a sound checkpoint"
                    )


def model_key(extractor: FeatureExtractor) -> str:
    """Key of what computes the features: model, provider, and the weights' hash, because two models
    may have the same name.
    """
    if isinstance(extractor, OnnxExtractor):
        return f"{extractor.name} {extractor.info.sha256}"
    return extractor.name


def load_extractor(
    model: Path | None = None,
    *,
    threads: int = 2,
    size: tuple[int, int] | None = None,
    half: bool = False,
    finest: int = 1,
) -> FeatureExtractor:
    """The extractor for `model`; None: the shipped weights.

    Options: see `OnnxExtractor`. Without shipped weights the gradient extractor is used, with a
    warning. `ModelError` if a given model is missing or corrupt.
    """
    if model is None:
        if not SHIPPED_MODEL.exists():
            _log.warning("no model file at %s: using gradient features", SHIPPED_MODEL)
            return GradientExtractor()
        model = SHIPPED_MODEL
    if not model.exists():
        raise ModelError(f"{model}: no such model file; leave it out to use the shipped weights")
    return OnnxExtractor(model, threads=threads, size=size, half=half, finest=finest)
