"""The CUDA backend of the optimizer: one launch refines a level's hypotheses."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from localizer.geometry.pose import Array
from localizer.registration.backend import LevelProblem, LMSettings, QuadraticPrior, Refinement
from localizer.registration.cuda import layout
from localizer.registration.cuda.compiler import Image, compile_kernels
from localizer.registration.cuda.driver import Arena, Device, Kernels

FEW = 16  # hypotheses at most for which larger blocks pay: they leave multiprocessors idle anyway

Compile = Callable[[int, tuple[int, int]], Image]


class CudaBackend:
    """Refines hypotheses on the GPU. Buffers are kept between calls; calls run one at a time.

    compile: makes the kernels for (channels, architecture).
    """

    def __init__(self, device: Device, *, compile: Compile = compile_kernels) -> None:
        self.device = device
        self.name = f"cuda ({device.name})"
        self._compile = compile
        self._kernels: dict[int, Kernels] = {}
        self.lock = threading.Lock()
        self.arena = Arena(device)

    def kernels(self, channels: int) -> Kernels:
        """The loaded kernels for a channel count; the first call compiles for seconds, once per
        machine. The device must be active. `CudaError` if that fails.
        """
        if channels not in self._kernels:
            image = self._compile(channels, self.device.architecture)
            self._kernels[channels] = self.device.load(image.code)
        return self._kernels[channels]

    @property
    def memory(self) -> int:
        """Bytes of device memory in use."""
        return self.arena.size

    def refine(
        self,
        problem: LevelProblem,
        rotations: Array,
        translations: Array,
        iterations: int,
        settings: LMSettings,
    ) -> Refinement:
        """See `Backend.refine`."""
        M = len(rotations)
        with self.lock:
            self.device.activate()
            kernels = self.kernels(problem.features.shape[-1])
            arguments = self.arguments(problem, rotations, translations, iterations, settings)
            name, threads = ("refine_few", 512) if M <= FEW else ("refine_many", 256)
            kernels.launch(name, M, threads, arguments)
            R, t = np.empty((M, 3, 3)), np.empty((M, 3))
            scores, visible = np.empty(M), np.empty(M, dtype=np.int32)
            state = np.empty((), dtype=layout.STATE)
            swarm = arguments["swarm"]
            for array, field in (
                (R, "rotations"), (t, "translations"), (scores, "scores"), (visible, "visible")
            ):  # fmt: skip
                self.device.download(array, int(swarm[field]))
            self.device.download(state, int(arguments["state"]))
            self.device.synchronize()
        return Refinement(
            R, t, scores, visible / problem.points.shape[1], int(state["evaluations"])
        )

    def close(self) -> None:
        """Free the buffers in device memory; a later call allocates them again."""
        with self.lock:
            self.device.activate()
            self.arena.close()

    def arguments(
        self,
        problem: LevelProblem,
        rotations: Array,
        translations: Array,
        iterations: int,
        settings: LMSettings,
    ) -> NDArray[np.void]:
        """Upload a problem and return the argument structure of `refine_many` or `refine_few`.
        Takes no lock; the caller holds it.
        """
        put, M = self.arena.put, len(rotations)
        level = np.zeros((), dtype=layout.LEVEL)
        level["features"] = put("features", as_floats(problem.features))
        level["confidence"] = put("confidence", as_floats(problem.confidence))
        level["points"] = put("points", as_floats(problem.points))
        level["anchor_features"] = put("anchor_features", as_floats(problem.anchor_features))
        level["anchor_confidence"] = put("anchor_confidence", as_floats(problem.anchor_confidence))
        level["height"], level["width"] = problem.confidence.shape
        level["total"] = problem.points.shape[1]
        level["focal"], level["centre"] = problem.focal, problem.centre
        state = np.zeros((), dtype=layout.STATE)
        state["count"] = M
        arguments = np.zeros((), dtype=layout.REFINE)
        arguments["level"] = put("level", level)
        arguments["state"] = put("state", state)
        if problem.prior is not None:
            arguments["prior"] = put("prior", packed_prior(problem.prior))
        arguments["swarm"] = (
            put("rotations", np.ascontiguousarray(rotations, dtype=np.float64)),
            put("translations", np.ascontiguousarray(translations, dtype=np.float64)),
            self.arena.buffer("scores", 8 * M),
            self.arena.buffer("visible", 4 * M),
        )
        set_loss(arguments, settings, iterations)
        arguments["counted"] = True
        return arguments


def set_loss(arguments: NDArray[np.void], settings: LMSettings, iterations: int) -> None:
    """Write LM and loss settings to the refine kernel's arguments."""
    arguments["damping"] = settings.damping
    arguments["damping_down"] = settings.damping_down
    arguments["damping_up"] = settings.damping_up
    arguments["min_overlap"] = settings.min_overlap
    arguments["scale"] = settings.scale
    arguments["redescending"] = settings.redescending
    arguments["iterations"] = iterations


def packed_prior(prior: QuadraticPrior) -> NDArray[np.void]:
    """A prior as the kernels' structure."""
    packed = np.zeros((), dtype=layout.PRIOR)
    packed["rotation"] = prior.camera_from_local.rotation
    packed["translation"] = prior.camera_from_local.translation
    packed["information"] = prior.information
    packed["weight"] = prior.weight
    return packed


def as_floats(array: NDArray[np.floating]) -> NDArray[np.float32]:
    """A contiguous array in the device's precision."""
    return np.ascontiguousarray(array, dtype=np.float32)
