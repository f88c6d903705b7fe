// The CUDA kernels of the registration (docs/explanation/registration.md, docs/how-to/gpu.md), compiled at run time.
#ifndef CUDA_EMULATION
// Two IEEE halves to float, without the toolkit's headers, which are not there at run time.
__device__ __forceinline__ void half_pair(unsigned bits, float& low, float& high) {
    asm("{ .reg .b16 l, h; mov.b32 {l, h}, %2; cvt.f32.f16 %0, l; cvt.f32.f16 %1, h; }"
        : "=f"(low), "=f"(high)
        : "r"(bits));
}
#endif

#include "layout.cuh"
#include "schedule.cuh"
