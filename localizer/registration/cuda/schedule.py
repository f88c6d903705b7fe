"""The whole registration on the device: one graph from the swarm to the winner's covariance sums.

The kernels read everything that changes from frame to frame (level descriptions with the addresses
of the features, poses, priors) from device memory, so the graph is captured once per configuration
and launched for every frame. What comes back is about one kilobyte: the surviving poses with their
scores, the sums of equation 11, and the quality.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from localizer.device_array import DeviceArray
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array
from localizer.registration.backend import (
    LevelProblem,
    QuadraticPrior,
    level_intrinsics,
)
from localizer.registration.config import JNGOConfig
from localizer.registration.covariance import CovarianceSums
from localizer.registration.cpu.reference import count_in_view
from localizer.registration.cuda import layout
from localizer.registration.cuda.backend import CudaBackend, as_floats, packed_prior
from localizer.registration.cuda.curvature import (
    last_settings,
    level_without_features,
    winner_curvature,
    winner_motion,
)
from localizer.registration.cuda.driver import Graph
from localizer.registration.cuda.memory import PROBES, FrameMemory
from localizer.registration.cuda.steps import (
    COVARIANCE_ANCHORS,
    KERNELS,
    GraphShape,
    largest_counts,
    launches,
    refine_launch,
)
from localizer.registration.result import SearchSurvivors
from localizer.types import Anchors, FeatureLevel, FeaturePyramid, PosePrior


@dataclass(frozen=True)
class DeviceSearchResult:
    """Results from the device. survivors: their sums are without the prior; none without overlap.
    finite: False if features, confidences or points are not finite. upload_ms, graph_ms: device
    time, 0 unless timed.
    """

    survivors: SearchSurvivors
    finite: bool
    upload_ms: float = 0.0
    graph_ms: float = 0.0


class CudaSchedule:
    """Runs the search of `JNGO` on a `CudaBackend`."""

    def __init__(self, backend: CudaBackend, *, timed: bool = False) -> None:
        self._backend, self._device = backend, backend.device
        self._timed = timed
        self._graph: tuple[GraphShape, Graph] | None = None

    def run(  # noqa: PLR0913
        self,
        query: FeaturePyramid,
        camera: Camera,
        anchors: Anchors,
        origin: Array,
        swarm: tuple[Array, Array],
        config: JNGOConfig,
        motion: PosePrior | None = None,
        constraint: QuadraticPrior | None = None,
    ) -> DeviceSearchResult:
        """Refine, prune and sharpen a swarm (rotations, translations), camera_from_local.

        The query's features may be `DeviceArray`s, which are read in place. constraint: its weight
        is the share of the level's best score (`JNGOConfig.prior_weight`).
        """
        backend = self._backend
        with backend.lock:
            self._device.activate()
            channels = tuple(level.features.shape[-1] for level in query.levels)
            events = [self._device.event()] if self._timed else []
            memory = self._memory(len(channels), len(swarm[0]), config, len(anchors.points_world))
            self._upload(memory, query, camera, anchors, origin, swarm, config, motion, constraint)
            cell_px = config.correlation_px / query.levels[-1].stride
            shape = GraphShape(
                config, len(swarm[0]), channels, constraint is not None, cell_px,
                backend.arena.generation,
            )  # fmt: skip
            graph = self._captured(shape, memory)
            if self._timed:
                events.append(self._device.event())
            graph.launch()
            if self._timed:
                events.append(self._device.event())
            last = len(channels) - 1 if config.sharpen else len(config.iterations) - 1
            count = len(anchors.points_world)
            result, sums, scale = self._collect(memory, config, count, channels[last])
            if len(result.survivors.scores) > 0 and result.finite:
                points = np.ascontiguousarray((anchors.points_world - origin).T, dtype=np.float32)
                level = query.levels[last]
                seen = level_without_features(
                    points, *level_intrinsics(camera, level), level.confidence.shape
                )
                found = result.survivors
                sums = self._with_curvature(found, sums, shape, memory, last, seen, scale)
                result = replace(result, survivors=replace(found, sums=sums))
            if not self._timed:
                return result
            upload, run = (self._device.elapsed_ms(*events[k : k + 2]) for k in (0, 1))
            return replace(result, upload_ms=upload, graph_ms=run)

    def _with_curvature(
        self,
        found: SearchSurvivors,
        sums: CovarianceSums,
        shape: GraphShape,
        memory: FrameMemory,
        level: int,
        seen: LevelProblem,
        scale: float,
    ) -> CovarianceSums:
        """The sums with motion, counts and curvature. seen: the level's geometry; scale: of its
        loss.
        """
        c = shape.config
        wanted = COVARIANCE_ANCHORS if c.sharpen else c.swarm_anchors[-1]
        few = replace(seen, points=seen.points[:, :: max(1, seen.points.shape[1] // wanted)])
        pose = found.rotations[0], found.translations[0]
        motion = winner_motion(few, *pose)
        settings = last_settings(c.settings, scale)
        step = refine_launch(
            shape, memory, level, memory.probes, PROBES, 0 if c.sharpen else wanted, settings, 0,
            free=True,
        )  # fmt: skip
        curvature = winner_curvature(
            self._backend, memory, step, shape.channels[level], pose, motion, sums.hessian,
            c.curvature_px,
        )  # fmt: skip
        fitted = seen if c.sharpen else few
        return replace(
            sums,
            motion=motion,
            anchors=count_in_view(fitted, *pose),
            share=few.points.shape[1] / fitted.points.shape[1],
            curvature=curvature,
        )

    def _captured(self, shape: GraphShape, memory: FrameMemory) -> Graph:
        if self._graph is not None and self._graph[0] == shape:
            return self._graph[1]
        if self._graph is not None:
            self._graph[1].destroy()
            self._graph = None
        for channels in set(shape.channels):  # loading a module is not allowed during a capture
            self._backend.kernels(channels).load_all(KERNELS)
        graph = self._device.capture(lambda: self._enqueue(shape, memory))
        self._graph = shape, graph
        return graph

    def _enqueue(self, shape: GraphShape, memory: FrameMemory) -> None:
        for step in launches(shape, memory, self._device.multiprocessors):
            kernels = self._backend.kernels(shape.channels[step.level])
            kernels.launch(step.kernel, step.blocks, step.threads, step.arguments)

    def _memory(self, levels: int, count: int, config: JNGOConfig, anchors: int) -> FrameMemory:
        finish = _taking_part(anchors, COVARIANCE_ANCHORS)
        finish = max(finish, _taking_part(anchors, config.swarm_anchors[-1]))
        return FrameMemory.of(
            self._backend.arena.buffer, levels, 2 * count, largest_counts(config, count)[-1], finish
        )

    def _upload(  # noqa: PLR0913
        self,
        memory: FrameMemory,
        query: FeaturePyramid,
        camera: Camera,
        anchors: Anchors,
        origin: Array,
        swarm: tuple[Array, Array],
        config: JNGOConfig,
        motion: PosePrior | None,
        constraint: QuadraticPrior | None,
    ) -> None:
        put = self._backend.arena.put
        frame = np.zeros(memory.upload_size, np.uint8)
        points = np.ascontiguousarray((anchors.points_world - origin).T, dtype=np.float32)
        address = put("points", points)
        for k, level in enumerate(query.levels):
            packed = _packed_level(self._backend, k, level, camera, anchors)
            packed["points"], packed["total"] = address, points.shape[1]
            memory.write(frame, memory.level(k), packed)
        if motion is not None and config.motion_weight > 0:
            memory.write(frame, memory.motion, _packed_motion(motion, origin, config))
        if constraint is not None:
            memory.write(frame, memory.prior, packed_prior(replace(constraint, weight=0.0)))
        state = np.zeros((), dtype=layout.STATE)
        state["count"] = len(swarm[0])
        memory.write(frame, memory.state, state)
        first = memory.swarms[0]
        # Twice: the second copy is not refined on the first level, and joins the second.
        memory.write(frame, int(first["rotations"]), np.concatenate([swarm[0]] * 2))
        memory.write(frame, int(first["translations"]), np.concatenate([swarm[1]] * 2))
        self._device.upload(memory.base, frame)

    def _collect(
        self, memory: FrameMemory, config: JNGOConfig, anchors: int, channels: int
    ) -> tuple[DeviceSearchResult, CovarianceSums, float]:
        """The download, its sums without motion, counts and curvature, and the last scale."""
        block = np.empty(memory.result_size, np.uint8)
        self._device.download(block, memory.prior)
        self._device.synchronize()

        def read(address: int, dtype: DTypeLike, shape: tuple[int, ...] = ()) -> NDArray[Any]:
            kind = np.dtype(dtype)
            start = address - memory.prior
            stop = start + kind.itemsize * int(np.prod(shape, dtype=np.int64))
            values: NDArray[Any] = block[start:stop].view(kind).reshape(shape)
            return values

        state = read(memory.state, layout.STATE)
        count, swarm = int(state["count"]), memory.swarms[-1]
        taking_part = _taking_part(anchors, config.swarm_anchors[-1])
        total = max(float(state["total"]), 1e-30)
        variance = float(state["square_sum"]) / max(float(state["scale_sum"]), 1e-12) / channels
        sums = CovarianceSums(
            _symmetric(state["hessian"]) / total,
            _symmetric(state["meat"]) / total**2,
            _symmetric(state["isotropic"]) / total**2 * variance,
            int(state["cells"]),
            prior_hessian=np.zeros((6, 6)),
            motion=np.zeros((6, 6)),
            anchors=0,
        )
        survivors = SearchSurvivors(
            read(int(swarm["rotations"]), np.float64, (count, 3, 3)).copy(),
            read(int(swarm["translations"]), np.float64, (count, 3)).copy(),
            read(int(swarm["scores"]), np.float64, (count,)).copy(),
            read(int(swarm["visible"]), np.int32, (count,)) / taking_part,
            sums,
            float(read(memory.prior, layout.PRIOR)["weight"]),
            float(state["quality"]),
            int(state["evaluations"]),
        )
        finite = not int(state["not_finite"])
        return DeviceSearchResult(survivors, finite), sums, float(state["scale"])


def _taking_part(total: int, wanted: int) -> int:
    """Number of anchors that `subsample_anchors` keeps."""
    step = max(1, total // wanted)
    return -(-total // step)


def _packed_level(
    backend: CudaBackend, k: int, level: FeatureLevel, camera: Camera, anchors: Anchors
) -> NDArray[np.void]:
    """A level's description without its points; its features are copied to the device."""
    put = backend.arena.put
    packed = np.zeros((), dtype=layout.LEVEL)
    packed["features"] = _query_address(backend, f"features {k}", level.features)
    packed["confidence"] = _query_address(backend, f"confidence {k}", level.confidence)
    packed["anchor_features"] = put(f"anchor features {k}", as_floats(anchors.features[k]))
    packed["anchor_confidence"] = put(f"anchor confidence {k}", as_floats(anchors.confidence[k]))
    packed["height"], packed["width"] = level.confidence.shape
    packed["focal"], packed["centre"] = level_intrinsics(camera, level)
    return packed


def _query_address(backend: CudaBackend, name: str, values: object) -> int:
    """Device address of query values: their own if they are on the device, else that of a copy."""
    if isinstance(values, DeviceArray):
        return values.checked_address(np.float32)
    return backend.arena.put(name, as_floats(np.asarray(values)))


def _packed_motion(motion: PosePrior, origin: Array, config: JNGOConfig) -> NDArray[np.void]:
    packed = np.zeros((), dtype=layout.MOTION)
    packed["rotation"] = motion.world_from_camera.rotation
    packed["centre"] = motion.world_from_camera.translation
    packed["information"] = np.linalg.pinv(motion.covariance, hermitian=True)
    packed["origin"] = origin
    packed["weight"] = config.motion_weight
    return packed


def _symmetric(triangle: NDArray[np.float32]) -> Array:
    """(6, 6) of a lower triangle stored by rows."""
    out: Array = np.zeros((6, 6))
    out[np.tril_indices(6)] = triangle
    full: Array = out + np.tril(out, -1).T
    return full
