// The product's kernels, unchanged, behind the emulation; KERNEL_SOURCE names the file.
#include <algorithm>
#include "cuda_emulation.h"
#include KERNEL_SOURCE

#define KERNEL(name, Arguments)                                                              \
    extern "C" { extern const size_t emulated_##name##_bytes; }                               \
    const size_t emulated_##name##_bytes = sizeof(Arguments);                     \
    extern "C" int emulated_##name(void** parameters, unsigned grid, unsigned threads,       \
                                   unsigned order, char* problem, size_t size) {             \
        Arguments arguments;                                                                 \
        std::memcpy(&arguments, parameters[0], sizeof arguments);                            \
        const std::string text = emulation::launch(                                          \
            [](void* a) { name(*static_cast<const Arguments*>(a)); }, &arguments, grid, threads, \
            order);                                                                          \
        std::snprintf(problem, size, "%s", text.c_str());                                    \
        return text.empty() ? 0 : 1;                                                         \
    }

#ifdef FAULTY
#define KERNELS                         \
    KERNEL(no_barrier, Arguments)       \
    KERNEL(with_barrier, Arguments)     \
    KERNEL(divergent_barrier, Arguments) \
    KERNEL(missing_lanes, Arguments)    \
    KERNEL(beyond_the_end, Arguments)   \
    KERNEL(far_beyond, Arguments)       \
    KERNEL(far_before, Arguments)       \
    KERNEL(uninitialised, Arguments)
#else
#define KERNELS                                         \
    KERNEL(refine_many, RefineArguments)                \
    KERNEL(refine_few, RefineArguments)                 \
    KERNEL(select_hypotheses, SelectArguments)          \
    KERNEL(weigh_prior, PriorWeightArguments)           \
    KERNEL(median_residual, WinnerArguments)            \
    KERNEL(covariance_sums, WinnerArguments)            \
    KERNEL(quality, WinnerArguments)                    \
    KERNEL(all_finite, FiniteArguments)
#endif
KERNELS
