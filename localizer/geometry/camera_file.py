"""Reads camera parameters from files: this project's ``camera.json``, ROS, Kalibr, OpenCV and
COLMAP.

The lens model follows from its name or its coefficients' names. Unknown models and coefficients are
rejected: a truncated model would give positions with errors of metres.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from localizer.errors import CameraError
from localizer.geometry.lens import COEFFICIENTS, LensModel, whole_coefficients
from localizer.plain_files import load_json, load_yaml, plain_text

KEYS = ("width", "height", "fx", "fy", "cx", "cy")
_MODEL_KEY = re.compile(r"(?i)(camera|lens|distortion|projection)?_?(model|type)|lens|projection")
_LIST_KEY = re.compile(r"(?i).*distort.*|.*coeff.*|dist|d")
_SINGLE_KEY = re.compile(r"[kpsb]\d+|tau_?[xy]|xi|alpha|beta|omega|skew", re.IGNORECASE)
_COLMAP = re.compile(r"\d+ +([A-Z_]+) +(\d+) +(\d+)((?: +[-+.\deE]+)+)")
_OTHER_KEYS = {
    "w": "width", "image_width": "width", "h": "height", "image_height": "height",
    "xresolution": "width", "yresolution": "height",
    "fl_x": "fx", "fl_y": "fy", "taux": "tau_x", "tauy": "tau_y",
}  # fmt: skip

# Lens models by the names that COLMAP, Kalibr, OpenSfM, Nerfstudio, ROS and others give them, no
# case and signs, and how many coefficients each may have. None: says nothing of the distortion.
_Form = tuple[LensModel, tuple[int, ...]]
_FEW = (0, 1, 2, 3, 4, 5)
_ANY: _Form = ("opencv", (*_FEW, 8, 12, 14))
_MODELS: dict[str, _Form | None] = {
    "opencv": _ANY, "pinhole": None, "perspective": None,
    "none": ("opencv", (0,)), "simplepinhole": ("opencv", (0,)),
    **dict.fromkeys(
        ("brown", "brownconrady", "plumbbob", "radtan", "radialtangential", "radial",
         "simpleradial"),
        ("opencv", _FEW),
    ),
    **dict.fromkeys(("rational", "rationalpolynomial", "fullopencv"), ("opencv", (8,))),
    "thinprism": ("opencv", (12,)), "tilted": ("opencv", (14,)),
    **dict.fromkeys(
        ("fisheye", "opencvfisheye", "fisheyeopencv", "equidistant", "equi", "kannalabrandt",
         "kannalabrandt4", "kannalabrandt8", "kb4", "simplefisheye", "simpleradialfisheye",
         "radialfisheye"),
        ("fisheye", (0, 1, 2, 3, 4)),
    ),
}  # fmt: skip
_READ = (
    "read are pinhole, Brown (plumb_bob, radtan), rational (rational_polynomial, FULL_OPENCV), "
    "thin_prism, tilted and fisheye (equidistant, Kannala-Brandt, OPENCV_FISHEYE); calibrate with "
    "one of them, or give undistorted images and their pinhole"
)


def read_numbers(path: Path) -> dict[str, Any]:
    """Parameters of one camera under the file's own keys, for `camera_numbers`, which checks them.
    The file is JSON, YAML (ROS ``camera_info``, Kalibr's camchain, OpenCV's FileStorage) or
    COLMAP's ``cameras.txt``. `CameraError` if it is missing, in no such format, or no mapping.
    """
    try:
        text = plain_text(path)
        lines = [x for x in text.splitlines() if x.strip() and not x.startswith("#")]
        if lines and (colmap := _COLMAP.fullmatch(lines[0].strip())):
            data: Any = _of_colmap(colmap, len(lines))
        elif text.lstrip()[:1] in ("{", "["):
            data = load_json(text)
        elif text.lstrip().startswith("<"):
            raise ValueError("it is XML; export OpenCV's YAML or COLMAP's cameras.txt")
        else:  # OpenCV's FileStorage is YAML but for its first line and its tags
            data = load_yaml(re.sub(r"^%YAML:1\.0|!!opencv-matrix", "", text))
    except FileNotFoundError as error:
        raise CameraError(f"{path}: does not exist") from error
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise CameraError(f"{path}: cannot be read as JSON or YAML: {error}") from error
    if not isinstance(data, dict):
        raise CameraError(f"{path}: expected an object with {', '.join(KEYS)}")
    return data


def camera_numbers(data: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of `Camera`, from the keys of this project or another program (module
    docstring). ValueError, TypeError or OverflowError for invalid data.
    """
    flat = _flat(data)
    forms = _forms(flat)
    for name in ("camera_matrix", "K", "k", "intrinsics"):
        if flat.get(name) is not None:
            flat |= _of_matrix(_numbers(flat[name], name), name)
    missing = [k for k in KEYS if k not in flat]
    if missing:
        raise ValueError(f"missing {', '.join(missing)}")
    model, k = _lens(flat, forms)
    return {
        **{key: int(flat[key]) for key in KEYS[:2]},
        **{key: float(flat[key]) for key in KEYS[2:]},
        "distortion": k,
        "distortion_model": model,
        "readout_ms": float(flat.get("readout_ms", 0.0)),
    }


def _flat(data: Mapping[str, Any]) -> dict[str, Any]:
    """One camera's numbers under this project's keys, from any program."""
    inner = [v for v in data.values() if isinstance(v, Mapping)]
    if len(inner) == len(data) == 1:  # Kalibr's cam0, OpenSfM's name of a camera
        data = inner[0]
    flat = {_OTHER_KEYS.get(str(key).lower(), str(key)): value for key, value in data.items()}
    if isinstance(flat.get("distortion"), Mapping) and "data" not in flat["distortion"]:
        flat |= flat.pop("distortion")
    if "resolution" in flat:
        flat["width"], flat["height"] = _numbers(flat["resolution"], "resolution")
    return flat


def _of_matrix(k: Sequence[float], name: str) -> dict[str, float]:
    """fx, fy, cx, cy of a matrix (3, 3) or list by OpenCV (first pixel's centre at 0, 0)."""
    if len(k) not in (4, 9) or (len(k) == 9 and k[1] != 0.0):
        raise ValueError(f"{name}: expected a matrix of 3x3 without skew, or fx fy cx cy")
    fx, fy, cx, cy = k if len(k) == 4 else (k[0], k[4], k[2], k[5])
    return {"fx": fx, "fy": fy, "cx": cx + 0.5, "cy": cy + 0.5}


def _of_colmap(line: re.Match[str], count: int) -> dict[str, Any]:
    """COLMAP's CAMERA_ID MODEL WIDTH HEIGHT PARAMS; first pixel's centre at 0.5, as here."""
    if count > 1:
        raise ValueError(f"{count} cameras; leave one line, the images' camera")
    name, params = line[1], [float(x) for x in line[4].split()]
    one = name.startswith("SIMPLE") or name in ("RADIAL", "RADIAL_FISHEYE")  # focal length
    fx, fy, cx, cy, *k = [params[0], *params] if one else params
    size = {"width": int(line[2]), "height": int(line[3])}
    return {"model": name, **size, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": k}


def _forms(flat: Mapping[str, Any]) -> dict[str, _Form]:
    """The lens models that the file names."""
    named = {k: v for k, v in flat.items() if _MODEL_KEY.fullmatch(k) and v is not None}
    if isinstance(named.get("lens"), int | float):  # CUAV's: the lens's focal length, mm
        del named["lens"]
    names = [str(v) for v in named.values()]
    forms = {name: form for name in names if (form := _model(name)) is not None}
    if len({model for model, _ in forms.values()}) > 1:
        raise ValueError(f"{' and '.join(forms)} are two lens models; give one")
    return forms or {"opencv": _ANY}


def _lens(
    flat: Mapping[str, Any], forms: Mapping[str, _Form]
) -> tuple[LensModel, tuple[float, ...]]:
    """Lens model and coefficients for `Camera`."""
    model = next(iter(forms.values()))[0]
    k = _coefficients(flat, model)
    used = max((i + 1 for i, value in enumerate(k) if value != 0.0), default=0)
    for name, (_, counts) in forms.items():
        if not any(used <= count <= len(k) for count in counts):
            raise ValueError(
                f"{len(k)} distortion coefficients, but the lens model {name} has "
                f"{counts[0]}{'' if len(counts) == 1 else f' to {counts[-1]}'} of "
                f"{' '.join(COEFFICIENTS[model])}; say by distortion_model which it is"
            )
    return model, whole_coefficients(model, k)


def _model(name: str) -> _Form | None:
    plain = re.sub(r"[^a-z0-9]", "", name.lower())
    if plain not in _MODELS:
        raise ValueError(f"the lens model {name!r} is not read; {_READ}")
    return _MODELS[plain]


def _coefficients(flat: Mapping[str, Any], model: LensModel) -> tuple[float, ...]:
    """Coefficients in the model's order, from a list or from single keys."""
    order = COEFFICIENTS[model]
    singles = {k: float(v) for k, v in flat.items() if _SINGLE_KEY.fullmatch(k)}
    foreign = [k for k, v in singles.items() if v != 0.0 and k not in order]
    if foreign:
        raise ValueError(f"{', '.join(foreign)}: no coefficient of the lens model {model}; {_READ}")
    last = max((order.index(k) + 1 for k in singles if k in order), default=0)
    found = [tuple(singles.get(k, 0.0) for k in order[:last])] if any(singles.values()) else []
    found += [
        _numbers(v, k)
        for k, v in flat.items()
        if _LIST_KEY.fullmatch(k) and not _MODEL_KEY.fullmatch(k) and v and v is not True
    ]
    if len(set(found)) > 1:
        raise ValueError("the distortion stands there twice, with other numbers; give one")
    return found[0] if found else ()


def _numbers(given: Any, name: str) -> tuple[float, ...]:
    """The numbers of a list, a matrix, or ROS's or OpenCV's form of one."""
    if isinstance(given, Mapping) and "data" in given:
        given = given["data"]
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise ValueError(f"{name}: expected numbers, got {given!r}")
    return tuple(float(x) for x in np.asarray(given, np.float64).ravel())
