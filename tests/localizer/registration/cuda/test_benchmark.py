"""The GPU benchmark's own code, on the emulated device: it must not fail first on a rented GPU."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from rich.console import Console


@pytest.fixture
def benchmark(monkeypatch):
    from benchmarks.optimizer import gpu as optimizer_gpu
    from benchmarks.optimizer import problem as optimizer_problem

    monkeypatch.setattr(optimizer_gpu, "REPEATS", 1)
    monkeypatch.setattr(optimizer_gpu, "WARM_UP", 0)
    monkeypatch.setattr(optimizer_problem, "ANCHORS", 40)
    few = tuple((label, config, 60) for label, config, _ in optimizer_gpu.SCHEDULES)
    monkeypatch.setattr(optimizer_gpu, "SCHEDULES", few)
    monkeypatch.setattr(optimizer_gpu, "torch_ms", lambda *_: np.nan)
    small = partial(optimizer_gpu.copy_bandwidth, size=2**16)
    monkeypatch.setattr(optimizer_gpu, "copy_bandwidth", small)
    return optimizer_problem, optimizer_gpu


def printed(gpu, problems, swarm):
    console = Console(record=True, width=200)
    gpu.print_tables(console, problems, swarm)
    return console.export_text()


def test_every_cell_is_filled_on_a_device(emulator, benchmark, make_emulated, monkeypatch):
    problem, gpu = benchmark
    monkeypatch.setattr(gpu, "CudaBackend", make_emulated)
    monkeypatch.setattr(gpu, "Device", lambda: emulator.device)
    tiny = partial(problem.make_problem)
    monkeypatch.setattr(gpu, "make_problem", lambda size, **k: tiny(min(size, 32), **k))
    swarm = problem.make_swarm(2)
    text = printed(gpu, {size: tiny(size) for size in (24, 32)}, swarm)
    assert "fused float16" in text
    for line in text.splitlines():
        if line.startswith("│") and "paper" not in line and "PyTorch" not in line:
            assert " - " not in line, line
    assert text.count("% of the peak") == 4


def test_without_a_device_there_are_dashes_and_a_reason(benchmark, monkeypatch):
    problem, gpu = benchmark

    def none():
        raise gpu.CudaError("no such thing")

    monkeypatch.setattr(gpu, "Device", none)
    text = printed(gpu, {32: problem.make_problem(32)}, problem.make_swarm(2))
    assert "no GPU column: no such thing" in text
    assert "fused float32 │" in text
