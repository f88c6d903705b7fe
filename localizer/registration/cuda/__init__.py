"""Registration on an NVIDIA GPU (gpu.md): kernels compiled at run time, without a CUDA toolkit."""
