"""Errors of the CUDA backend."""

from __future__ import annotations

from localizer.errors import BackendError


class CudaError(BackendError):
    """A call of the driver or run-time compiler failed, or there is no usable GPU."""


class CudaUnavailableError(CudaError):
    """There is no GPU, driver or run-time compiler; the text says which and what to do."""
