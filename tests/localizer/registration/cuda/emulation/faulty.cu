// Kernels with one mistake each, to show that the emulation notices it.
struct Arguments {
    int* values;
    int count;
};

// Reads its neighbour's value without waiting for it.
void no_barrier(const Arguments a) {
    __shared__ int shared[64];
    shared[threadIdx.x] = (int)threadIdx.x;
    a.values[threadIdx.x] = shared[(threadIdx.x + 1) % 64];
}

void with_barrier(const Arguments a) {
    __shared__ int shared[64];
    shared[threadIdx.x] = (int)threadIdx.x;
    __syncthreads();
    a.values[threadIdx.x] = shared[(threadIdx.x + 1) % 64];
}

void divergent_barrier(const Arguments a) {
    if (threadIdx.x < 32) {
        __syncthreads();
        a.values[threadIdx.x] = 1;
    } else {
        __syncthreads();
        a.values[threadIdx.x] = 2;
    }
}

// Half a warp does not take part in the exchange that names it.
void missing_lanes(const Arguments a) {
    if (threadIdx.x % 32 < 16) a.values[threadIdx.x] = __shfl_xor_sync(0xffffffffu, 1, 1);
}

void beyond_the_end(const Arguments a) { a.values[a.count + (int)threadIdx.x] = 1; }

// A whole array's length off, as with a wrong stride.
void far_beyond(const Arguments a) { a.values[4096 * (int)(1 + threadIdx.x)] = 1; }

void far_before(const Arguments a) { a.values[-4096 * (int)(1 + threadIdx.x)] = 1; }

// Shared memory is not zero at the start.
void uninitialised(const Arguments a) {
    __shared__ int shared[64];
    a.values[threadIdx.x] = shared[threadIdx.x];
}
