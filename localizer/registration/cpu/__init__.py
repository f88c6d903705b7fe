"""Registration on the CPU: the numba kernel, and the specification that it is held against."""
