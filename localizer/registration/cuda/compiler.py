"""Compiles the kernels at run time with NVRTC and caches the images on disk.

It needs no nvcc and no toolkit headers, only the packages `cuda-bindings` and NVRTC's own wheel
(extra `gpu`).
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from localizer.caches import cache_folder
from localizer.registration.cuda.errors import CudaError, CudaUnavailableError
from localizer.registration.cuda.layout import macros

SOURCES = Path(__file__).parent
_MAIN = "jngo.cu"
_OPTIONS = ("--std=c++17", "--device-as-default-execution-space")


@dataclass(frozen=True)
class Image:
    """Machine code for one architecture. log: the assembler's report of registers and spills,
    empty when the image came from the cache.
    """

    code: bytes
    log: str


def compile_kernels(
    channels: int, architecture: tuple[int, int], cache: Path | None = None
) -> Image:
    """Compile the kernels for one channel count and compute capability, or load them from the cache
    folder (None: "cuda" in PILOT_CACHE or the user's cache).

    If the cache cannot be written, the kernels are compiled at every start. Raises
    `CudaUnavailableError` without NVRTC, `CudaError` if it refuses the source.
    """
    sources = {path.name: path.read_text() for path in sorted(SOURCES.glob("*.cu*"))}
    nvrtc = load_nvrtc()
    options = [f"--gpu-architecture=sm_{architecture[0]}{architecture[1]}", *_OPTIONS]
    options += [f"-D{name}={value}" for name, value in macros(channels).items()]
    version = _checked(nvrtc, nvrtc.nvrtcVersion())
    path = (cache or cache_folder("cuda")) / f"{_digest(sources, options, version)}.cubin"
    try:
        return Image(path.read_bytes(), "")
    except OSError:
        image = compile_image(nvrtc, sources, options)
    _store(path, image.code)
    return image


def _digest(sources: Mapping[str, str], options: list[str], version: tuple[int, int]) -> str:
    digest = hashlib.sha256(repr((sorted(sources.items()), options, version)).encode())
    return digest.hexdigest()[:32]


def _store(path: Path, code: bytes) -> None:
    """Write by renaming, so that no other process reads an incomplete image."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(code)
        Path(file.name).replace(path)
    except OSError:
        return


def compile_image(nvrtc: ModuleType, sources: Mapping[str, str], options: list[str]) -> Image:
    """Compile the main source with the others as headers, without the cache. `CudaError` with the
    compiler's log if it fails.
    """
    headers = {name: text for name, text in sources.items() if name != _MAIN}
    program = _checked(
        nvrtc,
        nvrtc.nvrtcCreateProgram(
            sources[_MAIN].encode(),
            _MAIN.encode(),
            len(headers),
            [text.encode() for text in headers.values()],
            [name.encode() for name in headers],
        ),
    )
    try:
        arguments = [option.encode() for option in (*options, "--ptxas-options=-v")]
        status = nvrtc.nvrtcCompileProgram(program, len(arguments), arguments)[0]
        log = _text(nvrtc, program, nvrtc.nvrtcGetProgramLogSize, nvrtc.nvrtcGetProgramLog)
        if status != nvrtc.nvrtcResult.NVRTC_SUCCESS:
            raise CudaError(f"NVRTC does not compile the kernels ({' '.join(options[:1])}):\n{log}")
        size = _checked(nvrtc, nvrtc.nvrtcGetCUBINSize(program))
        code = bytes(size)
        _checked(nvrtc, nvrtc.nvrtcGetCUBIN(program, code))
        return Image(code, log)
    finally:
        nvrtc.nvrtcDestroyProgram(program)


def _text(nvrtc: ModuleType, program: Any, size_of: Any, fill: Any) -> str:
    text = b" " * _checked(nvrtc, size_of(program))
    _checked(nvrtc, fill(program, text))
    line: str = text.rstrip(b"\0").decode(errors="replace")
    return line


def _checked(nvrtc: ModuleType, result: tuple[Any, ...]) -> Any:
    status, *values = result
    if status != nvrtc.nvrtcResult.NVRTC_SUCCESS:
        raise CudaError(f"NVRTC failed: {status.name}")
    return values[0] if values else None


def load_nvrtc() -> ModuleType:
    """Load NVIDIA's run-time compiler; `CudaUnavailableError` if it is missing."""
    try:
        from cuda.bindings import nvrtc

        status = nvrtc.nvrtcVersion()[0]
    except ImportError as error:
        raise CudaUnavailableError(
            f"no CUDA bindings ({error}): install the extra `gpu`"
        ) from error
    except RuntimeError as error:  # the bindings' own error for a library that is not there
        raise CudaUnavailableError(
            f"no run-time compiler (NVRTC): install the extra `gpu` ({_first_line(error)})"
        ) from error
    if status != nvrtc.nvrtcResult.NVRTC_SUCCESS:
        raise CudaUnavailableError(f"the run-time compiler (NVRTC) does not start: {status.name}")
    compiler: ModuleType = nvrtc
    return compiler


def _first_line(error: Exception) -> str:
    return str(error).strip().split("\n")[0]
