"""A detection network in onnxruntime: frames in, boxes in the frame's pixels out."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import onnxruntime as ort

from companion.config import DetectorConfig
from companion.errors import DetectorError
from companion.targets.detections import CLICKED
from companion.targets.detector.boxes import Box, Layout, decode, layout_of
from localizer.types import Float32, Image

_LONGEST = 48  # characters of a class's name: a target's has room for a number behind it
_SIZE = 640  # of networks that take any: what they are trained with
_PADDING = 114  # grey, as these networks are trained


class DetectorNetwork:
    """Loads a model and runs it. Not thread-safe. `DetectorError`. labels: name of each class."""

    def __init__(self, config: DetectorConfig) -> None:
        self._threshold = config.threshold
        options = ort.SessionOptions()
        options.intra_op_num_threads = 1  # it may take its time; the localizer may not
        options.log_severity_level = 3
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        self._session = _session(config.model, options)
        given = self._session.get_inputs()
        if len(given) != 1 or len(given[0].shape) != 4 or given[0].shape[1] not in (3, "3"):
            shapes = ", ".join(f"{i.name} {i.shape}" for i in given)
            raise DetectorError(f"{config.model}: takes {shapes}, not one image (1, 3, H, W)")
        if given[0].type != "tensor(float)":
            raise DetectorError(f"{config.model}: takes {given[0].type}, not tensor(float)")
        self._input = given[0].name
        height, width = (side if isinstance(side, int) else _SIZE for side in given[0].shape[2:])
        self._size = (width, height)
        self.labels = _labels(config, self._session)
        self._wanted = _wanted(config, self.labels)
        self._layout = self._find_layout(config)

    def detect(self, image: Image) -> list[Box]:
        """Wanted objects in an (H, W, 3) RGB frame, in its pixels, best first."""
        blob, scale, (left, top) = _letterboxed(image, self._size)
        boxes = decode(self._run(blob), self._layout, self._threshold)
        return [
            replace(
                box,
                left=(box.left - left) / scale,
                top=(box.top - top) / scale,
                right=(box.right - left) / scale,
                bottom=(box.bottom - top) / scale,
            )
            for box in boxes
            if self._wanted is None or box.label in self._wanted
        ]

    def name_of(self, label: int) -> str:
        """The network's name of the class with that number; "class N" if unknown."""
        return self.labels.get(label, f"class {label}")

    def _run(self, blob: Float32) -> Float32:
        return np.asarray(self._session.run(None, {self._input: blob})[0], dtype=np.float32)

    def _find_layout(self, config: DetectorConfig) -> Layout:
        """Found by running a black image: a network's shapes may be symbols until it has run."""
        try:
            shape = self._run(np.zeros((1, 3, *self._size[::-1]), np.float32)).shape
        except Exception as error:  # onnxruntime has many of its own
            raise DetectorError(f"{config.model}: does not run: {error}") from error
        if config.layout is not None:
            return config.layout
        try:
            return layout_of(shape, len(self.labels) or None, self._size)[0]
        except DetectorError as error:
            raise DetectorError(f"{config.model}: {error}") from error


def _session(model: Path, options: ort.SessionOptions) -> ort.InferenceSession:
    if not model.is_file():
        raise DetectorError(f"targets.detector.model {model}: there is no such file")
    try:
        return ort.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise DetectorError(f"targets.detector.model {model}: no ONNX network: {error}") from error


def _labels(config: DetectorConfig, session: ort.InferenceSession) -> dict[int, str]:
    """Names by class number: the deployment's, else those that Ultralytics' exporter writes."""
    if config.labels:
        return dict(enumerate(config.labels))
    told = session.get_modelmeta().custom_metadata_map.get("names", "")
    try:
        names = ast.literal_eval(told) if told else {}
        return {int(k): f"{v}" for k, v in names.items() if _is_name(str(v))}
    except (ValueError, SyntaxError, AttributeError):
        return {}


def _is_name(label: str) -> bool:
    is_name = 0 < len(label) <= _LONGEST and label.isprintable()
    return is_name and not f"{label} ".startswith(CLICKED)


def _wanted(config: DetectorConfig, labels: dict[int, str]) -> frozenset[int] | None:
    """Numbers of the classes that are reported; None: all."""
    if not config.classes:
        return None
    unknown = [name for name in config.classes if name not in labels.values()]
    if unknown:
        known = ", ".join(labels.values()) or "none: set targets.detector.labels"
        raise DetectorError(
            f"targets.detector.classes: {', '.join(unknown)} is no class of {config.model}; "
            f"it names {known}"
        )
    return frozenset(k for k, name in labels.items() if name in config.classes)


def _letterboxed(image: Image, size: tuple[int, int]) -> tuple[Float32, float, tuple[float, float]]:
    """The image scaled into the network's, (1, 3, H, W) in 0 to 1; scale and left, top, pixels."""
    h, w = image.shape[:2]
    scale = min(size[0] / w, size[1] / h)
    new = (max(round(w * scale), 1), max(round(h * scale), 1))
    shrunk = cv2.resize(image, new, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    left, top = (size[0] - new[0]) // 2, (size[1] - new[1]) // 2
    canvas = np.full((size[1], size[0], 3), _PADDING, np.uint8)
    canvas[top : top + new[1], left : left + new[0]] = shrunk
    blob = np.ascontiguousarray(canvas.transpose(2, 0, 1)[None], dtype=np.float32) / np.float32(255)
    return blob, scale, (float(left), float(top))
