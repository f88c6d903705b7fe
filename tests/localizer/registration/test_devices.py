"""The choice of the device: what is missing is told in one line, and the CPU takes over."""

from __future__ import annotations

import logging
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from localizer.registration import devices
from localizer.registration.config import JNGOConfig
from localizer.registration.cpu.kernel import NumbaBackend
from localizer.registration.cuda import backend as cuda_backend
from localizer.registration.cuda import compiler, driver, schedule
from localizer.registration.cuda.errors import CudaError, CudaUnavailableError
from localizer.registration.devices import open_backend
from localizer.registration.jngo import JNGO


def lines(caplog):
    return [r for r in caplog.records if r.name.startswith("localizer.registration")]


def test_cpu_asks_for_nothing(monkeypatch, caplog):
    def never():
        raise AssertionError("the driver was asked")

    monkeypatch.setattr(devices, "Device", never)
    assert isinstance(open_backend("cpu", 1), NumbaBackend)
    assert lines(caplog) == []


@pytest.mark.parametrize(("choice", "level"), [("auto", logging.INFO), ("cuda", logging.WARNING)])
def test_without_bindings(monkeypatch, caplog, choice, level):
    caplog.set_level(logging.INFO)
    monkeypatch.setitem(sys.modules, "cuda.bindings", None)
    assert isinstance(open_backend(choice, 1), NumbaBackend)
    (line,) = lines(caplog)
    assert line.levelno == level
    assert "extra `gpu`" in line.getMessage()
    assert "\n" not in line.getMessage()


def fake_driver(monkeypatch, status, count=1):
    """Bindings whose driver answers like this."""
    result = SimpleNamespace(CUDA_SUCCESS=0, CUDA_ERROR_NO_DEVICE=100)

    def start(_flags):
        if isinstance(status, Exception):
            raise status
        return (status,)

    fake = SimpleNamespace(CUresult=result, cuInit=start, cuDeviceGetCount=lambda: (0, count))
    monkeypatch.setitem(sys.modules, "cuda.bindings", SimpleNamespace(driver=fake))
    monkeypatch.setitem(sys.modules, "cuda.bindings.driver", fake)


@pytest.mark.parametrize(
    ("status", "count", "text"),
    [
        (RuntimeError("libcuda.so.1 not found"), 1, "no NVIDIA driver"),
        (100, 1, "sees no GPU"),
        (0, 0, "sees no GPU"),
    ],
)
def test_without_driver_or_gpu(monkeypatch, caplog, status, count, text):
    caplog.set_level(logging.INFO)
    fake_driver(monkeypatch, status, count)
    assert isinstance(open_backend("auto", 1), NumbaBackend)
    (line,) = lines(caplog)
    assert text in line.getMessage()


class _Gpu:
    """A device that opens and can do nothing."""

    name, architecture, multiprocessors = "a GPU", (9, 0), 132

    def activate(self):
        return None


@pytest.mark.parametrize(
    ("error", "level"),
    [
        (CudaUnavailableError("no run-time compiler (NVRTC): install the extra `gpu`"), "INFO"),
        (CudaError("NVRTC does not compile the kernels (sm_90):\nline 1\nline 2"), "WARNING"),
    ],
)
def test_without_a_compiler_that_works(monkeypatch, caplog, error, level):
    """A GPU that is there and does not serve is a warning even under auto."""
    caplog.set_level(logging.INFO)

    def refuse(*_):
        raise error

    monkeypatch.setattr(devices, "Device", _Gpu)
    monkeypatch.setattr(
        devices, "CudaBackend", lambda device: cuda_backend.CudaBackend(device, compile=refuse)
    )
    assert isinstance(open_backend("auto", 1), NumbaBackend)
    (line,) = lines(caplog)
    assert line.levelname == level
    assert "line 1" not in line.getMessage()


def test_missing_compiler_library_is_named(monkeypatch):
    def missing():
        raise RuntimeError("libnvrtc.so.12 not found\nand more")

    fake = SimpleNamespace(nvrtcVersion=missing, nvrtcResult=SimpleNamespace(NVRTC_SUCCESS=0))
    monkeypatch.setitem(sys.modules, "cuda.bindings", SimpleNamespace(nvrtc=fake))
    monkeypatch.setitem(sys.modules, "cuda.bindings.nvrtc", fake)
    with pytest.raises(CudaUnavailableError, match=r"NVRTC.*extra `gpu`"):
        compiler.compile_kernels(32, (9, 0))


def test_a_gpu_that_fails_in_flight_leaves_the_cpu(monkeypatch, caplog, scene, prior):
    """The frame is still registered, once told, and the next ones do not try again."""
    monkeypatch.setattr(driver, "Arena", lambda _device: None)
    backend = cuda_backend.CudaBackend(_Gpu())
    failed = []
    config = JNGOConfig(hypotheses=9, survivors=(4, 2))
    optimizer = JNGO(config, backend, 1)
    assert optimizer.on_gpu

    def fail(*_a, **_k):
        failed.append(True)
        raise CudaError("cuLaunchKernel failed: CUDA_ERROR_LAUNCH_FAILED")

    monkeypatch.setattr(schedule.CudaSchedule, "run", fail)
    arguments = (scene.query, scene.camera, scene.anchors, prior(scene.reference, 1.0, 1.0))
    found = optimizer.register(*arguments)
    again = optimizer.register(*arguments)
    expected = JNGO(config, threads=1).register(*arguments)
    for result in (found, again):
        np.testing.assert_array_equal(
            result.world_from_camera.matrix, expected.world_from_camera.matrix
        )
    assert failed == [True]
    assert not optimizer.on_gpu
    (line,) = lines(caplog)
    assert "continues on the CPU" in line.getMessage()
    assert optimizer.backend.name.startswith("numba")
