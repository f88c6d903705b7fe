"""Time of feature extraction: `tiny` and `s0` on every execution provider there is, in one table.

    python -m benchmarks.features.network_speed [--s0 MODEL.onnx] [--threads 2] [--json out.json]

Without a model of `s0` an untrained one is exported (extra `train`): weights do not change its
time. The features are copied back to the host, as in flight. Medians of time and of processor time
on all threads. The providers take turns, and their first calls, in which engines are built, are not
counted.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.arguments import Parser, existing, output, whole
from benchmarks.common.figures import show_figures
from benchmarks.common.named_errors import named_errors
from localizer.errors import ModelError
from localizer.features.extractor import SHIPPED_MODEL, OnnxExtractor
from localizer.features.providers import SHORT_NAMES, available_providers

ROOT = Path(__file__).resolve().parents[2]
SIZES = ((320, 240), (640, 480))
_WARM = 3  # calls that are not counted
COLUMNS = ("network", "provider", "size", "time, ms", "processor, ms")


@dataclass(frozen=True)
class SpeedRow:
    """One row: a network on a provider at an image size."""

    model: str
    provider: str
    size: tuple[int, int]
    time_ms: float
    cpu_ms: float


def untrained_s0(folder: Path) -> list[Path]:
    """`s0` in float32 and float16 with random weights."""
    try:
        import torch

        from localizer.training.config import load_config
        from localizer.training.export.export import export
        from localizer.training.models.networks import build
    except ModuleNotFoundError as error:
        raise ModelError(
            f"an untrained s0 needs {error.name}: pip install '.[train]', or give --s0 MODEL.onnx"
        ) from error

    run = load_config(ROOT / "configs" / "train_s0.yaml")
    checkpoint = folder / "s0.pt"
    torch.manual_seed(0)
    state = {"average": build(run.model).state_dict(), "config": run.model_dump(mode="json"),
             "step": 0, "seconds": 0.0}  # fmt: skip
    torch.save(state, checkpoint)
    models = [folder / "s0.onnx", folder / "s0-float16.onnx"]
    for model in models:
        export(checkpoint, model, half=model is models[1])
    return models


def measure(
    models: Sequence[Path], sizes: Sequence[tuple[int, int]], threads: int, count: int
) -> Iterator[SpeedRow]:
    """Every model at every size on every installed provider that runs it."""
    installed = [SHORT_NAMES[n] for n in available_providers() if n in SHORT_NAMES]
    for model, size in itertools.product(models, sizes):
        runs: dict[OnnxExtractor, list[tuple[float, float]]] = {}
        for provider in installed:
            try:
                runs[OnnxExtractor(model, threads=threads, size=size, only=provider)] = []
            except ModelError as error:
                print(f"left out: {error}")
        image = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
        for _ in range(count + _WARM):
            for extractor, times in runs.items():
                began, cpu = time.perf_counter(), time.process_time()
                extractor.extract(image)
                times.append((time.perf_counter() - began, time.process_time() - cpu))
        for extractor, times in runs.items():
            time_ms, cpu_ms = 1e3 * np.median(times[_WARM:], axis=0)
            yield SpeedRow(extractor.info.name, extractor.provider, size, time_ms, cpu_ms)


def cells(row: SpeedRow) -> tuple[str, ...]:
    """As `COLUMNS` names them."""
    size = f"{row.size[0]} x {row.size[1]}"
    return row.model, row.provider, size, f"{row.time_ms:.2f}", f"{row.cpu_ms:.2f}"


def main() -> None:
    parser = Parser(__doc__)
    parser.add_argument("--s0", type=existing, nargs="*", help="models of s0, instead of untrained")
    parser.add_argument("--threads", type=whole(1, 256), default=2, help="on the CPU")
    parser.add_argument(
        "--count", type=whole(1, 100_000), default=30, help="calls that are counted"
    )
    parser.add_argument("--json", type=output, help="the table, for benchmarks.site.keep")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        models = [SHIPPED_MODEL, *(args.s0 or untrained_s0(Path(folder)))]
        rows = [cells(row) for row in measure(models, SIZES, args.threads, args.count)]
        show_figures(args.json, COLUMNS, rows)


if __name__ == "__main__":
    with named_errors():
        main()
