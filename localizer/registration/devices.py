"""Selects the registration backend: a working GPU, else the CPU."""

from __future__ import annotations

import logging
from typing import Literal

import numpy as np

from localizer.errors import BackendError
from localizer.registration.backend import Backend, LevelProblem, LMSettings
from localizer.registration.cpu.kernel import NumbaBackend
from localizer.registration.cuda.backend import CudaBackend
from localizer.registration.cuda.driver import Device
from localizer.registration.cuda.errors import CudaUnavailableError

_log = logging.getLogger(__name__)

DeviceChoice = Literal["auto", "cpu", "cuda"]
_TRIAL_CHANNELS = 32  # the networks'


def open_backend(device: DeviceChoice = "auto", threads: int = 2) -> Backend:
    """Open the backend for a choice of device; falls back to the CPU.

    A GPU is tested: driver, run-time compiler, and a small problem. If a test fails, the CPU is
    used, and one log line gives the reason. It is a warning if the GPU was asked for or is present
    but does not work, otherwise an information.
    """
    if device == "cpu":
        return NumbaBackend(threads)
    try:
        backend = CudaBackend(Device())
        warm_up(backend, _TRIAL_CHANNELS)
    except CudaUnavailableError as error:
        return _on_the_cpu(error, logging.INFO if device == "auto" else logging.WARNING, threads)
    except BackendError as error:
        return _on_the_cpu(error, logging.WARNING, threads)
    return backend


def _on_the_cpu(error: BackendError, level: int, threads: int) -> Backend:
    text = str(error).split("\n")[0]
    _log.log(level, "registration on the CPU: %s", text)
    return NumbaBackend(threads)


def warm_up(backend: Backend, channels: int) -> None:
    """Run one step on a small random problem, to compile or load the kernels."""
    rng = np.random.default_rng(0)
    problem = LevelProblem(
        rng.standard_normal((8, 8, channels)).astype(np.float32),
        np.ones((8, 8), np.float32),
        (4.0, 4.0),
        (4.0, 4.0),
        rng.uniform(-1, 1, (3, 20)).astype(np.float32),
        rng.standard_normal((20, channels)).astype(np.float32),
        np.ones(20, np.float32),
    )
    backend.refine(problem, np.eye(3)[None], np.array([[0.0, 0.0, 4.0]]), 1, LMSettings())
