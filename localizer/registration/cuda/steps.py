"""The launches of a registration's graph, in order (registration.md, section 7)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from localizer.registration.backend import LMSettings
from localizer.registration.config import JNGOConfig
from localizer.registration.cuda import layout
from localizer.registration.cuda.backend import FEW, set_loss
from localizer.registration.cuda.memory import FrameMemory
from localizer.registration.selection import LEAST_SCORE

COVARIANCE_ANCHORS = 1000
LEAST_SCALE = 0.02
_MANY_THREADS, _FEW_THREADS, _SMALL_THREADS = 256, 512, 256
_FINITE_BLOCKS_PER_MULTIPROCESSOR = 4


@dataclass(frozen=True)
class GraphShape:
    """Parameters that a captured graph depends on."""

    config: JNGOConfig
    hypotheses: int
    channels: tuple[int, ...]
    constrained: bool
    cell_px: float
    generation: int


KERNELS = (
    "all_finite", "refine_many", "refine_few", "select_hypotheses", "weigh_prior",
    "median_residual", "covariance_sums", "quality",
)  # fmt: skip


@dataclass(frozen=True)
class KernelLaunch:
    """One launch of the graph. level: its channel count is what the kernel is compiled for."""

    kernel: str
    level: int
    blocks: int
    threads: int
    arguments: NDArray[np.void]


def launches(
    shape: GraphShape, memory: FrameMemory, multiprocessors: int
) -> Iterator[KernelLaunch]:
    """Yield the kernel launches in order (docs/explanation/registration.md, section 7)."""
    c, searched = shape.config, len(shape.config.iterations)
    levels = len(shape.channels)
    for k in range(levels):
        finite = np.zeros((), dtype=layout.FINITE)
        finite["level"], finite["state"] = memory.level(k), memory.state
        blocks = _FINITE_BLOCKS_PER_MULTIPROCESSOR * multiprocessors
        yield KernelLaunch("all_finite", k, blocks, _SMALL_THREADS, finite)
    source, keep = 0, (*c.survivors[: searched - 1], c.hypotheses)
    for k, alive in enumerate(largest_counts(c, shape.hypotheses)[:-1]):
        swarm, wanted = memory.swarms[source], c.swarm_anchors[k]
        target = 2 if k == searched - 1 else 1 - source
        if shape.constrained:
            yield from _weighing(shape, memory, k, swarm, alive, wanted)
        yield refine_launch(shape, memory, k, swarm, alive, wanted, c.settings, c.iterations[k])
        yield _selecting(shape, memory, k, source, target, keep[k])
        source = target
    yield from _sharpening(shape, memory)


def largest_counts(config: JNGOConfig, starts: int) -> list[int]:
    """Largest number of hypotheses at each level and after the last. starts: start poses, which
    join the second level again.
    """
    keep = (*config.survivors[: len(config.iterations) - 1], config.hypotheses)
    counts = [starts]
    for k, most in enumerate(keep):
        joining = starts if k == 0 and len(keep) > 1 else 0
        counts.append(min(counts[-1], most) + joining)
    return counts


def _sharpening(shape: GraphShape, memory: FrameMemory) -> Iterator[KernelLaunch]:
    """The winner's last steps and the sums at its pose."""
    c, searched, levels = shape.config, len(shape.config.iterations), len(shape.channels)
    final, wanted = memory.swarms[2], c.swarm_anchors[-1]
    winner, scales = memory.winner(final), (c.sharpen_scales, c.detail_scales)
    finish = np.zeros((), dtype=layout.WINNER)
    finish["state"], finish["swarm"], finish["scratch"] = memory.state, final, memory.finish
    finish["scale"], finish["cell"], finish["wanted"] = c.huber, shape.cell_px, wanted
    used = range(searched - 1, levels) if c.sharpen else range(0)
    redescending = False
    for k in used:
        anchors = 0 if k == levels - 1 else wanted
        if shape.constrained:
            yield from _weighing(shape, memory, k, winner, 1, anchors)
        median = finish.copy()
        median["level"], median["wanted"] = memory.level(k), wanted
        yield KernelLaunch("median_residual", k, 1, _FEW_THREADS, median)
        for factor in scales[k - searched + 1]:
            settings = replace(
                c.settings, scale=LEAST_SCALE, redescending=True, damping=c.sharpen_damping
            )
            yield refine_launch(
                shape, memory, k, winner, 1, anchors, settings, c.sharpen, factor=factor
            )
            redescending = True
    last = levels - 1 if c.sharpen else searched - 1
    sums, quality = finish.copy(), finish
    sums["level"], sums["redescending"] = memory.level(last), redescending
    if c.sharpen:
        sums["wanted"] = COVARIANCE_ANCHORS
    yield KernelLaunch("covariance_sums", last, 1, _FEW_THREADS, sums)
    quality["level"] = memory.level(searched - 1)
    yield KernelLaunch("quality", searched - 1, 1, _FEW_THREADS, quality)


def refine_launch(  # noqa: PLR0913
    shape: GraphShape,
    memory: FrameMemory,
    level: int,
    swarm: NDArray[np.void],
    alive: int,
    wanted: int,
    settings: LMSettings,
    iterations: int,
    *,
    factor: float = 0.0,
    free: bool = False,
) -> KernelLaunch:
    """Launch of the LM kernel. alive: largest number of hypotheses; wanted: number of anchors, 0:
    all; factor: of the loss scale; free: without the prior, and its evaluations are not counted.
    """
    arguments = np.zeros((), dtype=layout.REFINE)
    arguments["level"], arguments["state"] = memory.level(level), memory.state
    arguments["prior"] = memory.prior if shape.constrained and not free else 0
    arguments["swarm"], arguments["wanted"] = swarm, wanted
    set_loss(arguments, settings, iterations)
    arguments["factor"], arguments["counted"] = factor, not free
    name, threads = ("refine_few", _FEW_THREADS) if alive <= FEW else ("refine_many", _MANY_THREADS)
    return KernelLaunch(name, level, alive, threads, arguments)


def _weighing(
    shape: GraphShape,
    memory: FrameMemory,
    level: int,
    swarm: NDArray[np.void],
    alive: int,
    wanted: int,
) -> Iterator[KernelLaunch]:
    """Score the swarm without the prior, then set the prior's weight by the best score."""
    c = shape.config
    yield refine_launch(shape, memory, level, swarm, alive, wanted, c.settings, 0, free=True)
    arguments = np.zeros((), dtype=layout.PRIOR_WEIGHT)
    arguments["prior"], arguments["state"] = memory.prior, memory.state
    arguments["scores"] = swarm["scores"]
    arguments["share"], arguments["least_score"] = c.prior_weight, LEAST_SCORE
    arguments["limit"] = alive
    yield KernelLaunch("weigh_prior", level, 1, _SMALL_THREADS, arguments)


def _selecting(
    shape: GraphShape,
    memory: FrameMemory,
    level: int,
    source: int,
    target: int,
    keep: int,
) -> KernelLaunch:
    """Rank and prune the swarm; the motion term counts in the last ranking only."""
    last = level == len(shape.config.iterations) - 1
    arguments = np.zeros((), dtype=layout.SELECT)
    arguments["level"], arguments["state"] = memory.level(level), memory.state
    arguments["motion"] = memory.motion if last else 0
    arguments["source"], arguments["target"] = memory.swarms[source], memory.swarms[target]
    arguments["totals"], arguments["order"] = memory.totals, memory.order
    arguments["alive"], arguments["projected"] = memory.alive, memory.projected
    arguments["distinct"], arguments["least_score"] = shape.config.duplicate_px, LEAST_SCORE
    arguments["wanted"], arguments["keep"] = shape.config.swarm_anchors[level], keep
    arguments["joining"] = level == 0 and not last
    return KernelLaunch("select_hypotheses", level, 1, _SMALL_THREADS, arguments)
