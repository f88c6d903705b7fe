"""NumPy types of the structures in layout.cuh: the kernels' input and output."""

from __future__ import annotations

import numpy as np

_POINTER = np.uint64


def _structure(*fields: tuple[str, object] | tuple[str, object, tuple[int, ...]]) -> np.dtype:
    return np.dtype(list(fields), align=True)


LEVEL = _structure(
    ("features", _POINTER),
    ("confidence", _POINTER),
    ("points", _POINTER),
    ("anchor_features", _POINTER),
    ("anchor_confidence", _POINTER),
    ("height", np.int32),
    ("width", np.int32),
    ("total", np.int32),
    ("unused", np.int32),
    ("focal", np.float32, (2,)),
    ("centre", np.float32, (2,)),
)
PRIOR = _structure(
    ("rotation", np.float64, (3, 3)),
    ("translation", np.float64, (3,)),
    ("information", np.float64, (6, 6)),
    ("weight", np.float64),
)
MOTION = _structure(
    ("rotation", np.float64, (3, 3)),
    ("centre", np.float64, (3,)),
    ("information", np.float64, (6, 6)),
    ("origin", np.float64, (3,)),
    ("weight", np.float64),
)
SWARM = _structure(
    ("rotations", _POINTER),
    ("translations", _POINTER),
    ("scores", _POINTER),
    ("visible", _POINTER),
)
STATE = _structure(
    ("median", np.float64),
    ("scale", np.float64),
    ("count", np.int32),
    ("evaluations", np.int32),
    ("not_finite", np.int32),
    ("cells", np.int32),
    ("quality", np.float32),
    ("total", np.float32),
    ("scale_sum", np.float32),
    ("square_sum", np.float32),
    ("hessian", np.float32, (21,)),
    ("meat", np.float32, (21,)),
    ("isotropic", np.float32, (21,)),
    ("unused", np.float32),
)
REFINE = _structure(
    ("level", _POINTER),
    ("prior", _POINTER),
    ("state", _POINTER),
    ("swarm", SWARM),
    ("damping", np.float64),
    ("damping_down", np.float64),
    ("damping_up", np.float64),
    ("min_overlap", np.float64),
    ("scale", np.float64),
    ("factor", np.float64),
    ("redescending", np.int32),
    ("iterations", np.int32),
    ("wanted", np.int32),
    ("counted", np.int32),
)
SELECT = _structure(
    ("level", _POINTER),
    ("motion", _POINTER),
    ("state", _POINTER),
    ("source", SWARM),
    ("target", SWARM),
    ("totals", _POINTER),
    ("order", _POINTER),
    ("alive", _POINTER),
    ("projected", _POINTER),
    ("distinct", np.float64),
    ("least_score", np.float64),
    ("wanted", np.int32),
    ("keep", np.int32),
    ("joining", np.int32),
    ("unused", np.int32),
)
PRIOR_WEIGHT = _structure(
    ("prior", _POINTER),
    ("state", _POINTER),
    ("scores", _POINTER),
    ("share", np.float64),
    ("least_score", np.float64),
    ("limit", np.int32),
    ("unused", np.int32),
)
WINNER = _structure(
    ("level", _POINTER),
    ("state", _POINTER),
    ("swarm", SWARM),
    ("scratch", _POINTER),
    ("scale", np.float64),
    ("cell", np.float32),
    ("redescending", np.int32),
    ("wanted", np.int32),
    ("unused", np.int32),
)
FINITE = _structure(("level", _POINTER), ("state", _POINTER))

PROBE_FLOATS = 48  # scratch per hypothesis of the select kernel: 2 * MAX_PROBES of schedule.cuh
WINNER_FLOATS = 8  # scratch per anchor of the kernels that look at the winner

_NAMES = {
    "Level": LEVEL,
    "Prior": PRIOR,
    "Motion": MOTION,
    "State": STATE,
    "RefineArguments": REFINE,
    "SelectArguments": SELECT,
    "PriorWeightArguments": PRIOR_WEIGHT,
    "WinnerArguments": WINNER,
    "FiniteArguments": FINITE,
}


def macros(channels: int, in_flight: int = 2) -> dict[str, int]:
    """Macros for the source, with the structures' sizes, which it checks.

    in_flight: anchors per group of lanes whose features are loaded before the first is used.
    """
    values = {"CHANNELS": channels, "IN_FLIGHT": in_flight}
    return values | {f"BYTES_OF_{name}": dtype.itemsize for name, dtype in _NAMES.items()}
