"""Registration on an NVIDIA GPU (gpu.md): kernels compiled at run time, without a CUDA toolkit."""

from localizer.registration.cuda.backend import CudaBackend
from localizer.registration.cuda.driver import Device
from localizer.registration.cuda.errors import CudaError, CudaUnavailableError

__all__ = ["CudaBackend", "CudaError", "CudaUnavailableError", "Device"]
