// CUDA's execution model on a CPU, for tests: the kernels' own source is compiled behind this header.
//
// Every thread of a block is a fibre that runs until it meets a barrier or a warp operation; blocks
// run one after the other. What a GPU leaves undefined is an error here: threads that wait at
// different barriers, warp operations that not all lanes of the mask reach, accesses beyond an
// allocation (the stand-in driver puts guard pages around them). Shared memory starts as NaN in every
// block. The order in which the fibres run is chosen by the caller: results that change with it are
// a missing barrier.
#pragma once
#include <csetjmp>
#include <csignal>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <mutex>
#include <random>
#include <stdexcept>
#include <string>
#include <ucontext.h>
#include <vector>

#define CUDA_EMULATION 1
#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __shared__ static __attribute__((section("emulated_shared")))

struct alignas(16) float4 { float x, y, z, w; };
struct alignas(16) uint4 { unsigned x, y, z, w; };
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
struct Index { unsigned x = 0, y = 0, z = 0; };

template <class To, class From> inline To bits_as(From from) {
    static_assert(sizeof(To) == sizeof(From));
    To to;
    std::memcpy(&to, &from, sizeof to);
    return to;
}
inline float __int_as_float(int bits) { return bits_as<float>(bits); }
inline int __float_as_int(float value) { return bits_as<int>(value); }
inline double __longlong_as_double(long long bits) { return bits_as<double>(bits); }
inline int __popc(unsigned bits) { return __builtin_popcount(bits); }
inline int min(int a, int b) { return a < b ? a : b; }
inline int max(int a, int b) { return a > b ? a : b; }
template <class T> inline T __ldg(const T* from) { return *from; }
inline int atomicAdd(int* to, int value) { int old = *to; *to += value; return old; }

namespace emulation {

constexpr int kWarp = 32;
constexpr size_t kStack = 96 * 1024;

enum class Wait { nothing, block, warp, done };
enum class Op { sync, exchange, ballot };

struct Fibre {
    ucontext_t start;
    jmp_buf where;
    bool started = false;
    Wait wait = Wait::nothing;
    int site = 0;  // line of the operation that it waits at
    Op op = Op::sync;
    unsigned mask = 0;
    uint64_t value = 0;  // brought, then taken
    int partner = 0;
    std::vector<char> stack;
};

struct Failure : std::runtime_error { using std::runtime_error::runtime_error; };

inline std::vector<Fibre> fibres(1024);
inline Fibre* current = nullptr;
inline Index thread, block, block_size, grid_size;
inline jmp_buf scheduler;
inline ucontext_t scheduler_start;
inline void (*body)(void*) = nullptr;
inline void* body_arguments = nullptr;
inline sigjmp_buf fault;
inline std::mutex running;

inline void pause() {
    if (_setjmp(current->where) == 0) _longjmp(scheduler, 1);
}

inline void enter() {
    body(body_arguments);
    current->wait = Wait::done;
    _longjmp(scheduler, 1);
}

inline void resume(Fibre& fibre, unsigned index) {
    current = &fibre;
    thread.x = index;
    if (_setjmp(scheduler)) return;
    if (fibre.started) _longjmp(fibre.where, 1);
    fibre.started = true;
    if (fibre.stack.empty()) fibre.stack.resize(kStack);
    getcontext(&fibre.start);
    fibre.start.uc_stack.ss_sp = fibre.stack.data();
    fibre.start.uc_stack.ss_size = kStack;
    fibre.start.uc_link = nullptr;
    makecontext(&fibre.start, enter, 0);
    setcontext(&fibre.start);
}

inline void block_barrier(int site) {
    current->wait = Wait::block;
    current->site = site;
    pause();
}

inline uint64_t warp_operation(int site, Op op, unsigned mask, uint64_t value, int partner) {
    Fibre& mine = *current;
    mine.wait = Wait::warp;
    mine.site = site;
    mine.op = op;
    mine.mask = mask;
    mine.value = value;
    mine.partner = partner;
    pause();
    return mine.value;
}

template <class T> inline T shuffle(int site, unsigned mask, T value, int partner) {
    uint64_t bits = 0;
    std::memcpy(&bits, &value, sizeof value);
    bits = warp_operation(site, Op::exchange, mask, bits, partner);
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

// Lets the lanes of a warp go on once all of their mask wait at the same operation.
inline bool release_warp(unsigned first) {
    const unsigned last = std::min(first + kWarp, block_size.x);
    uint64_t brought[kWarp] = {};
    unsigned mask = 0, ballot = 0;
    int site = -1;
    for (unsigned i = first; i < last; ++i) {
        const Fibre& f = fibres[i];
        if (f.wait != Wait::warp) continue;
        if (site < 0) site = f.site, mask = f.mask;
        if (f.site != site || f.mask != mask) return false;
    }
    if (site < 0) return false;
    for (unsigned lane = 0; lane < kWarp; ++lane) {
        if (!(mask >> lane & 1u)) continue;
        const Fibre& f = fibres[first + lane];
        if (first + lane >= last || f.wait != Wait::warp) return false;
        brought[lane] = f.value;
        ballot |= (f.value != 0) << lane;
    }
    for (unsigned lane = 0; lane < kWarp; ++lane) {
        if (!(mask >> lane & 1u)) continue;
        Fibre& f = fibres[first + lane];
        if (f.op == Op::exchange) f.value = brought[f.partner];
        if (f.op == Op::ballot) f.value = ballot;
        f.wait = Wait::nothing;
    }
    return true;
}

// Threads that have left the kernel count as arrived, as on the device.
inline bool release_block() {
    int site = -1;
    for (unsigned i = 0; i < block_size.x; ++i) {
        const Fibre& f = fibres[i];
        if (f.wait == Wait::done) continue;
        if (f.wait != Wait::block || (site >= 0 && f.site != site)) return false;
        site = f.site;
    }
    if (site < 0) return false;
    for (unsigned i = 0; i < block_size.x; ++i)
        if (fibres[i].wait == Wait::block) fibres[i].wait = Wait::nothing;
    return true;
}

[[noreturn]] inline void stuck() {
    std::string text = "threads wait for each other: block " + std::to_string(block.x);
    for (unsigned i = 0; i < block_size.x; ++i) {
        const Fibre& f = fibres[i];
        if (i && f.wait == fibres[i - 1].wait && f.site == fibres[i - 1].site) continue;
        text += "; from thread " + std::to_string(i) +
                (f.wait == Wait::done ? " finished"
                                      : (f.wait == Wait::block ? " block barrier, line "
                                                               : " warp operation, line ") +
                                            std::to_string(f.site));
    }
    throw Failure(text);
}

static char present __attribute__((section("emulated_shared"), used));  // in every library

extern "C" char __start_emulated_shared[], __stop_emulated_shared[];

// order: 0 ascending, 1 descending, else a seed for a new random order in every round.
inline void run_block(unsigned order, std::mt19937& random) {
    std::memset(__start_emulated_shared, 0xff, __stop_emulated_shared - __start_emulated_shared);
    std::vector<unsigned> turn(block_size.x);
    for (unsigned i = 0; i < block_size.x; ++i) {
        turn[i] = order == 1 ? block_size.x - 1 - i : i;
        fibres[i].started = false;
        fibres[i].wait = Wait::nothing;
    }
    for (;;) {
        if (order > 1) std::shuffle(turn.begin(), turn.end(), random);
        bool ran = false, left = false;
        for (unsigned i : turn) {
            if (fibres[i].wait == Wait::nothing) resume(fibres[i], i), ran = true;
            left |= fibres[i].wait != Wait::done;
        }
        if (!left) return;
        bool released = false;
        for (unsigned first = 0; first < block_size.x; first += kWarp) released |= release_warp(first);
        if (!released) released = release_block();
        if (!released && !ran) stuck();
        if (!released) {
            bool waiting = true;
            for (unsigned i = 0; i < block_size.x; ++i) waiting &= fibres[i].wait != Wait::nothing;
            if (waiting) stuck();
        }
    }
}

inline void on_fault(int) { siglongjmp(fault, 1); }

// Runs a grid; returns an empty string or what is wrong with the kernel.
inline std::string launch(void (*kernel)(void*), void* arguments, unsigned grid, unsigned threads,
                          unsigned order) {
    std::lock_guard<std::mutex> lock(running);
    static std::vector<char> signal_stack(64 * 1024);
    stack_t other{signal_stack.data(), 0, signal_stack.size()}, previous_stack;
    struct sigaction action{}, segv, bus;
    action.sa_handler = on_fault;
    action.sa_flags = SA_ONSTACK;
    sigaltstack(&other, &previous_stack);
    sigaction(SIGSEGV, &action, &segv);
    sigaction(SIGBUS, &action, &bus);
    std::string problem;
    if (sigsetjmp(fault, 1)) {
        problem = "access outside an allocation: block " + std::to_string(block.x) + ", thread " +
                  std::to_string(thread.x);
    } else {
        std::mt19937 random(order);
        body = kernel;
        body_arguments = arguments;
        block_size.x = threads;
        grid_size.x = grid;
        try {
            for (block.x = 0; block.x < grid; ++block.x) run_block(order, random);
        } catch (const Failure& failure) {
            problem = failure.what();
        }
    }
    sigaction(SIGSEGV, &segv, nullptr);
    sigaction(SIGBUS, &bus, nullptr);
    sigaltstack(&previous_stack, nullptr);
    return problem;
}

}  // namespace emulation

#define threadIdx emulation::thread
#define blockIdx emulation::block
#define blockDim emulation::block_size
#define gridDim emulation::grid_size
#define __syncthreads() emulation::block_barrier(__LINE__)
#define __syncwarp() \
    ((void)emulation::warp_operation(__LINE__, emulation::Op::sync, 0xffffffffu, 0, 0))
#define __shfl_xor_sync(mask, value, distance) \
    emulation::shuffle(__LINE__, mask, value, (int)(threadIdx.x % 32) ^ (distance))
#define __shfl_sync(mask, value, lane) emulation::shuffle(__LINE__, mask, value, lane)
#define __ballot_sync(mask, value) \
    ((unsigned)emulation::warp_operation(__LINE__, emulation::Op::ballot, mask, (value) ? 1 : 0, 0))
