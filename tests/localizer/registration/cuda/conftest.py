"""A CUDA device for tests: the real one, or an emulation of one that runs the same kernels.

The emulation compiles the product's kernel source with g++ (`emulation/`) and stands in for the
driver's library, so that the product's own host code runs unchanged down to `cuda.bindings`. It
shows its device only while a test holds the fixture.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from localizer.registration.cuda.backend import CudaBackend
from localizer.registration.cuda.compiler import SOURCES, Image, compile_kernels
from localizer.registration.cuda.driver import Device, Kernels
from localizer.registration.cuda.errors import CudaError
from localizer.registration.cuda.layout import macros

EMULATION = Path(__file__).parent / "emulation"
_FLAGS = [
    "-O1",
    "-std=c++17",
    "-shared",
    "-fPIC",
    "-w",
    "-fno-strict-aliasing",
    "-U_FORTIFY_SOURCE",
]


def build(source: Path, *options: str, reads: tuple[Path, ...] = ()) -> Path:
    """The shared library of a source file that includes `reads`; kept in the temporary folder by
    content.
    """
    digest = hashlib.sha256(repr((options, _FLAGS)).encode())
    for file in sorted([*SOURCES.glob("*.cu*"), *EMULATION.glob("*"), *reads]):
        digest.update(file.read_bytes())
    folder = Path(tempfile.gettempdir()) / f"pilot-cuda-emulation-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    library = folder / f"{source.stem}-{digest.hexdigest()[:24]}.so"
    if not library.exists():
        partial = Path(tempfile.mkdtemp(dir=folder)) / "library.so"
        command = ["g++", *_FLAGS, f"-I{EMULATION}", f"-I{SOURCES}", *options, str(source), "-o",
                   str(partial), "-ldl"]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.fail(f"g++ does not compile {source.name}:\n{done.stderr[:3000]}")
        partial.replace(library)
        partial.parent.rmdir()
    return library


def emulated_kernels(channels: int, architecture: tuple[int, int]) -> Image:
    """In place of `compile_kernels`."""
    options = [f"-D{name}={value}" for name, value in macros(channels).items()]
    kernels = f'-DKERNEL_SOURCE="{SOURCES / "jngo.cu"}"'
    return Image(f"emulated:{build(EMULATION / 'kernels.cpp', kernels, *options)}".encode(), "")


@dataclass(frozen=True)
class Counts:
    """What the stand-in has done so far. blocks: allocations that live."""

    launches: int
    graphs: int
    allocations: int
    blocks: int
    to_device: int
    to_host: int


class Emulator:
    """The stand-in driver and its device."""

    def __init__(self) -> None:
        self._library = ctypes.CDLL(str(standin_library()), mode=ctypes.RTLD_GLOBAL)
        self.enable(True)
        self.device = Device()

    def enable(self, on: bool) -> None:
        self._library.stand_in_enable(int(on))

    def order(self, order: int) -> None:
        """In which order threads run: 0 ascending, 1 descending, else a random one's seed."""
        self._library.stand_in_order(order)

    def problem(self) -> str:
        """What the kernels did wrong since the last call."""
        text = ctypes.create_string_buffer(512)
        self._library.stand_in_problem(text, len(text))
        return text.value.decode()

    def counts(self) -> Counts:
        values = (ctypes.c_long * 6)()
        self._library.stand_in_counts(values)
        return Counts(*values)


def standin_library() -> Path:
    """The library, under the name by which programs ask for the driver's."""
    return build(EMULATION / "libcuda.cpp", "-Wl,-soname,libcuda.so.1")


def real_driver() -> bool:
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


_REAL_DRIVER = real_driver()  # before the stand-in takes the name


@pytest.fixture(scope="session")
def _emulator() -> Emulator:
    pytest.importorskip("cuda.bindings", reason="cuda-bindings is not installed (extra `gpu`)")
    if shutil.which("g++") is None:
        pytest.skip("no g++ to compile the emulation with")
    if _REAL_DRIVER:
        pytest.skip("a real driver is loaded here: the tests marked gpu cover this")
    return Emulator()


@pytest.fixture
def emulator(_emulator: Emulator) -> Iterator[Emulator]:
    """The emulated device; a test in which a kernel did something undefined fails."""
    _emulator.enable(True)
    _emulator.order(0)
    yield _emulator
    _emulator.order(0)
    _emulator.enable(False)
    assert _emulator.problem() == ""


@pytest.fixture
def faulty(emulator: Emulator) -> Kernels:
    """The kernels of emulation/faulty.cu, loaded on the emulated device."""
    source = f'-DKERNEL_SOURCE="{EMULATION / "faulty.cu"}"'
    library = build(EMULATION / "kernels.cpp", source, "-DFAULTY")
    return emulator.device.load(f"emulated:{library}".encode())


@pytest.fixture
def real_device() -> Device:
    """The real GPU, or a skip with the reason."""
    if not _REAL_DRIVER:
        pytest.skip("no GPU: no NVIDIA driver (libcuda) on this machine")
    try:
        return Device()
    except CudaError as error:
        pytest.skip(f"no GPU: {error}")


@pytest.fixture(params=["emulated", pytest.param("real", marks=pytest.mark.gpu)])
def make_backend(request: pytest.FixtureRequest) -> Iterator[Callable[..., CudaBackend]]:
    """Makes backends on either device: ``make_backend()``; they are closed afterwards."""
    made: list[CudaBackend] = []
    real = request.param == "real"
    device = request.getfixturevalue("real_device" if real else "emulator")
    if isinstance(device, Emulator):
        device = device.device
    compile_ = compile_kernels if real else emulated_kernels

    def make() -> CudaBackend:
        made.append(CudaBackend(device, compile=compile_))
        return made[-1]

    yield make
    for backend in made:
        backend.close()
