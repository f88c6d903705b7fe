// The CUDA kernels of the registration (docs/explanation/registration.md, docs/how-to/gpu.md), compiled at run time.

#include "layout.cuh"
#include "schedule.cuh"
