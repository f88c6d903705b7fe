"""The emulated device notices what a GPU leaves undefined; else its verdicts would mean nothing."""

from __future__ import annotations

import mmap
from pathlib import Path

import numpy as np
import pytest

from localizer.registration.cuda.errors import CudaError

ARGUMENTS = np.dtype([("values", np.uint64), ("count", np.int32)], align=True)
THREADS = 64


@pytest.fixture
def run(emulator, faulty):
    """Runs a kernel; the values it wrote, or the driver's error."""
    device = emulator.device
    address = device.allocate(4 * THREADS)

    def launch(name, order=0):
        arguments = np.zeros((), dtype=ARGUMENTS)
        arguments["values"], arguments["count"] = address, THREADS
        values = np.empty(THREADS, np.int32)
        emulator.order(order)
        faulty.launch(name, 1, THREADS, arguments)
        device.download(values, address)
        device.synchronize()
        return values

    yield launch
    device.free(address)


def test_a_missing_barrier_shows_in_the_order_of_threads(run):
    assert not np.array_equal(run("no_barrier", 0), run("no_barrier", 1))
    expected = (np.arange(THREADS) + 1) % THREADS
    for order in (0, 1, 2):
        np.testing.assert_array_equal(run("with_barrier", order), expected)


@pytest.mark.parametrize(
    ("kernel", "text"),
    [
        ("divergent_barrier", "threads wait for each other"),
        ("missing_lanes", "threads wait for each other"),
        ("beyond_the_end", "access outside an allocation"),
        ("far_beyond", "access outside an allocation"),
        ("far_before", "access outside an allocation"),
    ],
)
def test_undefined_behaviour_is_an_error(emulator, run, kernel, text):
    with pytest.raises(CudaError, match="LAUNCH_FAILED"):
        run(kernel)
    assert text in emulator.problem()


def test_nothing_of_the_process_lies_where_a_wrong_index_may_write(emulator):
    device, reach = emulator.device, 1 << 22  # bytes; "far_beyond" goes a quarter of it
    page = mmap.PAGESIZE
    address = device.allocate(page)
    assert address % page == 0
    for start, end, rights in _mappings():
        near = start < address + page + reach and end > address - reach
        assert not near or rights == "---p" or (start, end) == (address, address + page)
    device.free(address)
    assert all(rights == "---p" for start, end, rights in _mappings() if start <= address < end)


def _mappings() -> list[tuple[int, int, str]]:
    """This process's memory: first address, end and rights of each mapping."""
    lines = [line.split() for line in Path("/proc/self/maps").read_text().splitlines()]
    spans = [(line[0].split("-"), line[1]) for line in lines]
    return [(int(start, 16), int(end, 16), rights) for (start, end), rights in spans]


def test_shared_memory_starts_as_rubbish(run):
    assert np.all(run("uninitialised") == -1)


def test_memory_is_checked_by_the_copies_too(emulator):
    device = emulator.device
    address = device.allocate(16)
    with pytest.raises(CudaError):
        device.upload(address, np.zeros(5, np.float32))
    assert "leaves its allocation" in emulator.problem()
    device.free(address)
    with pytest.raises(CudaError):
        device.free(address)
