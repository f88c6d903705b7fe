"""Registration on the CPU: numba kernel and reference implementation."""
