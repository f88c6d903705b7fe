// What lies between the levels and after the last one, so that a registration never leaves the
// device: ordering and pruning (equation 10), the weight of a prior (15), the median residual, the
// sums of the covariance (11) and the quality. Each kernel is one block, except all_finite.
#pragma once
#include "refine.cuh"

constexpr int PROBES = 12, MAX_PROBES = 2 * PROBES;

__device__ inline double infinity() { return __longlong_as_double(0x7ff0000000000000LL); }

// Least of the block's values, for every thread. `slots`: one double per warp.
__device__ inline double block_least(double value, double* slots) {
    for (int step = WARP / 2; step >= 1; step /= 2)
        value = fmin(value, __shfl_xor_sync(ALL, value, step));
    if (threadIdx.x % WARP == 0) slots[threadIdx.x / WARP] = value;
    __syncthreads();
    double least = slots[0];
    for (int w = 1; w < (int)blockDim.x / WARP; ++w) least = fmin(least, slots[w]);
    __syncthreads();
    return least;
}

// Squared Mahalanobis distance of a hypothesis to the prediction (equation 13).
__device__ inline double motion_distance(const Motion& motion, const double* R, const double* t) {
    double d[6], turn[9];
    for (int i = 0; i < 3; ++i) {
        d[i] = motion.origin[i] - motion.centre[i];
        for (int k = 0; k < 3; ++k) d[i] -= R[3 * k + i] * t[k];
    }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            double s = 0.0;
            for (int k = 0; k < 3; ++k) s += R[3 * k + i] * motion.rotation[3 * j + k];
            turn[3 * i + j] = s;
        }
    rotation_vector(turn, d + 3);
    double squared = 0.0;
    for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) squared += d[i] * motion.information[6 * i + j] * d[j];
    return squared;
}

// Orders the hypotheses by total cost (equation 10) and keeps the best distinct ones: of two whose
// probe anchors project closer than `distinct` (rms) the better one. Survivors go to `to`; if
// `joining`, as many poses as were ranked follow them, which lie behind those.
extern "C" __global__ void __launch_bounds__(256) select_hypotheses(const SelectArguments a) {
    __shared__ double slots[8];
    __shared__ int kept, finite;
    const int count = a.state->count, first = threadIdx.x, stride = blockDim.x;
    double mine = infinity();
    for (int m = first; m < count; m += stride) mine = fmin(mine, a.from.scores[m]);
    const double best = fmax(block_least(mine, slots), a.least_score);
    if (first == 0) kept = finite = 0;
    for (int m = first; m < count; m += stride) {
        double total = a.from.scores[m];
        if (a.motion && a.motion->weight > 0.0 && total < infinity())
            total += a.motion->weight * best *
                     motion_distance(*a.motion, a.from.rotations + 9 * m,
                                     a.from.translations + 3 * m);
        a.totals[m] = total;
    }
    __syncthreads();
    for (int m = first; m < count; m += stride) {
        const double total = a.totals[m];
        int rank = 0;
        for (int k = 0; k < count; ++k) {
            const double other = a.totals[k];
            rank += other < total || (other == total && k < m);
        }
        a.order[rank] = m;
        a.alive[rank] = total < infinity();
        if (total < infinity()) atomicAdd(&finite, 1);  // in shared memory; a count
    }
    __syncthreads();
    const Level& level = *a.level;
    const int step = step_for(level.total, a.wanted), anchors = (level.total + step - 1) / step;
    const int every = max(1, anchors / PROBES) * step;
    const int probes = min(MAX_PROBES, (level.total + every - 1) / every);
    for (int i = first; i < finite * probes; i += stride) {
        const int rank = i / probes, probe = i % probes, m = a.order[rank];
        Terms at;
        const PoseF pose = pose_of(a.from.rotations + 9 * m, a.from.translations + 3 * m);
        project(level, pose, probe * every, at);
        a.projected[2 * MAX_PROBES * rank + 2 * probe] = at.u;
        a.projected[2 * MAX_PROBES * rank + 2 * probe + 1] = at.v;
    }
    __syncthreads();
    const float limit = (float)(a.distinct * a.distinct) * (float)probes;
    int survivors = 0;
    for (int i = 0; i < finite && survivors < a.keep; ++i) {
        if (!a.alive[i]) continue;  // the same for all threads: written before a barrier
        ++survivors;
        for (int j = i + 1 + first; j < finite; j += stride) {
            float distance = 0.0f;
            for (int k = 0; k < 2 * probes; ++k) {
                const float d = a.projected[2 * MAX_PROBES * j + k] -
                                a.projected[2 * MAX_PROBES * i + k];
                distance += d * d;
            }
            if (!(distance > limit)) a.alive[j] = 0;
        }
        __syncthreads();
    }
    for (int i = first; i < finite; i += stride) {
        if (!a.alive[i]) continue;
        int place = 0;
        for (int k = 0; k < i; ++k) place += a.alive[k];
        if (place >= a.keep) continue;
        const int m = a.order[i];
        for (int k = 0; k < 9; ++k) a.to.rotations[9 * place + k] = a.from.rotations[9 * m + k];
        for (int k = 0; k < 3; ++k)
            a.to.translations[3 * place + k] = a.from.translations[3 * m + k];
        a.to.scores[place] = a.from.scores[m];
        a.to.visible[place] = a.from.visible[m];
        atomicAdd(&kept, 1);
    }
    __syncthreads();
    const int joining = a.joining && kept > 0 ? count : 0;
    for (int i = first; i < 9 * joining; i += stride)
        a.to.rotations[9 * kept + i] = a.from.rotations[9 * count + i];
    for (int i = first; i < 3 * joining; i += stride)
        a.to.translations[3 * kept + i] = a.from.translations[3 * count + i];
    if (first == 0) a.state->count = kept + joining;
}

// Equation 15's weight in units of the level's best score; nothing where no hypothesis has one.
extern "C" __global__ void __launch_bounds__(256) weigh_prior(const PriorWeightArguments a) {
    __shared__ double slots[8];
    double mine = infinity();
    const int count = min(a.state->count, a.limit);
    for (int m = threadIdx.x; m < count; m += blockDim.x) mine = fmin(mine, a.scores[m]);
    const double best = block_least(mine, slots);
    if (threadIdx.x == 0)
        a.prior->weight = best < infinity() ? a.share * fmax(best, a.least_score) : 0.0;
}

// Weighted median residual norm of the winner: the least norm up to which half the weight lies.
extern "C" __global__ void __launch_bounds__(512, 1) median_residual(const WinnerArguments a) {
    __shared__ BlockScratch<16> scratch;
    __shared__ double slots[16], half;
    if (a.state->count == 0) return;
    const Level level = *a.level;
    const int step = step_for(level.total, a.wanted), count = (level.total + step - 1) / step;
    const PoseF pose = pose_of(a.swarm.rotations, a.swarm.translations);
    float* norms = a.scratch;
    float* weights = a.scratch + count;
    float sums[WARP] = {};
    for (int base = 0; base < count; base += blockDim.x) {
        const int index = base + threadIdx.x;
        const Terms k = anchor_terms(level, pose, index < count, index * step, index * step,
                                     scratch.warps[threadIdx.x / WARP]);
        if (index >= count) continue;
        norms[index] = k.visible ? sqrtf(k.e) : __int_as_float(0x7f800000);
        weights[index] = k.weight;
        sums[0] += k.weight;
    }
    block_sum(sums, scratch);
    if (threadIdx.x == 0) half = 0.5 * scratch.sums[0];
    __syncthreads();
    double mine = infinity();
    for (int i = threadIdx.x; i < count; i += blockDim.x) {
        const float norm = norms[i];
        double below = 0.0;
        for (int k = 0; k < count; ++k) {
            const float other = norms[k];
            if (other < norm || (other == norm && k <= i)) below += (double)weights[k];
        }
        if (below >= half) mine = fmin(mine, (double)norm);
    }
    const double median = block_least(mine, slots);
    if (threadIdx.x == 0) a.state->median = median;
}

// The sums of equation 11 at the winner's pose, under the loss of its last steps.
extern "C" __global__ void __launch_bounds__(512, 1) covariance_sums(const WinnerArguments a) {
    __shared__ BlockScratch<16> scratch;
    if (a.state->count == 0) return;
    const Level level = *a.level;
    const PoseF pose = pose_of(a.swarm.rotations, a.swarm.translations);
    const float delta = (float)(a.redescending ? a.state->scale : a.scale);
    const int step = step_for(level.total, a.wanted), count = (level.total + step - 1) / step;
    const int across = (int)((float)(level.width - 1) / a.cell) + 1;
    const int cells = across * ((int)((float)(level.height - 1) / a.cell) + 1);
    float* slopes = a.scratch;                                // (count, 6)
    int* cell = reinterpret_cast<int*>(a.scratch + 6 * count);  // (count,); -1: out of view
    float sums[WARP] = {}, isotropic[WARP] = {};
    for (int base = 0; base < count; base += blockDim.x) {
        const int index = base + threadIdx.x;
        const Terms k = anchor_terms(level, pose, index < count, index * step, index * step,
                                     scratch.warps[threadIdx.x / WARP]);
        if (index < count) cell[index] = -1;
        if (!k.visible) continue;
        cell[index] = (int)(k.v / a.cell) * across + (int)(k.u / a.cell);
        const float w = k.weight * robust(k.e, delta, a.redescending).weight;
        float U[6], V[6], slope[6] = {}, unused[6] = {};
        projection_rows(level, pose, k, U, V);
        add_normal_equations(U, V, k, w, sums, slope);
        add_normal_equations(U, V, k, w * w, isotropic, unused);
#pragma unroll
        for (int i = 0; i < 6; ++i) slopes[6 * index + i] = slope[i];
        sums[21] += k.weight;
        sums[22] += w;
        sums[23] += w * k.e;
    }
    block_sum(sums, scratch);
    if (threadIdx.x == 0) {
        for (int i = 0; i < 21; ++i) a.state->hessian[i] = (float)scratch.sums[i];
        a.state->total = (float)scratch.sums[21];
        a.state->scale_sum = (float)scratch.sums[22];
        a.state->square_sum = (float)scratch.sums[23];
    }
    __syncthreads();
    block_sum(isotropic, scratch);
    if (threadIdx.x == 0)
        for (int i = 0; i < 21; ++i) a.state->isotropic[i] = (float)scratch.sums[i];
    __syncthreads();
    float meat[WARP] = {};
    for (int c = threadIdx.x; c < cells; c += blockDim.x) {
        float sum[6] = {};
        bool occupied = false;
        for (int k = 0; k < count; ++k) {
            if (cell[k] != c) continue;
            occupied = true;
#pragma unroll
            for (int i = 0; i < 6; ++i) sum[i] += slopes[6 * k + i];
        }
        if (!occupied) continue;
        meat[21] += 1.0f;
#pragma unroll
        for (int i = 0; i < 6; ++i)
#pragma unroll
            for (int j = 0; j <= i; ++j) meat[triangle(i, j)] += sum[i] * sum[j];
    }
    block_sum(meat, scratch);
    if (threadIdx.x == 0) {
        for (int i = 0; i < 21; ++i) a.state->meat[i] = (float)scratch.sums[i];
        a.state->cells = (int)scratch.sums[21];
    }
}

// 1 - cost / cost of chance, which pairs each anchor in view with another's features.
extern "C" __global__ void __launch_bounds__(512, 1) quality(const WinnerArguments a) {
    __shared__ BlockScratch<16> scratch;
    __shared__ int in_warp[16];
    if (a.state->count == 0) return;
    const Level level = *a.level;
    const PoseF pose = pose_of(a.swarm.rotations, a.swarm.translations);
    const int step = step_for(level.total, a.wanted);
    const int count = (level.total + step - 1) / step;
    const int lane = threadIdx.x % WARP, warp = threadIdx.x / WARP;
    int* list = reinterpret_cast<int*>(a.scratch);
    int visible = 0;
    for (int base = 0; base < count; base += blockDim.x) {
        const int index = base + threadIdx.x;
        Terms k = {};
        if (index < count) project(level, pose, index * step, k);
        const unsigned mask = __ballot_sync(ALL, k.visible);
        if (lane == 0) in_warp[warp] = __popc(mask);
        __syncthreads();
        int place = visible + __popc(mask & ((1u << lane) - 1u));
        for (int w = 0; w < (int)blockDim.x / WARP; ++w) {
            if (w < warp) place += in_warp[w];
            visible += in_warp[w];
        }
        if (k.visible) list[place] = index * step;
        __syncthreads();
    }
    float sums[WARP] = {};
    for (int base = 0; base < visible; base += blockDim.x) {
        const int index = base + threadIdx.x;
        const bool valid = index < visible;
        const int anchor = valid ? list[index] : 0;
        // As np.roll by half the list.
        const int other = valid ? list[(index + visible - visible / 2) % visible] : 0;
        Terms k = anchor_terms(level, pose, valid, anchor, anchor, scratch.warps[warp]);
        sums[0] += k.weight * robust(k.e, (float)a.scale, false).cost;
        k = anchor_terms(level, pose, valid, anchor, other, scratch.warps[warp]);
        sums[1] += k.weight * robust(k.e, (float)a.scale, false).cost;
    }
    block_sum(sums, scratch);
    if (threadIdx.x == 0) {
        const double share = 1.0 - scratch.sums[0] / fmax(scratch.sums[1], 1e-12);
        a.state->quality = (float)fmin(1.0, fmax(0.0, share));
    }
}

// Whether one of `count` values is NaN or infinite: all exponent bits are set.
__device__ inline bool any_not_finite(const float* values, size_t count) {
    const unsigned exponent = 0x7f800000u;
    const unsigned* bits = reinterpret_cast<const unsigned*>(values);
    bool bad = false;
    for (size_t i = (size_t)blockIdx.x * blockDim.x + threadIdx.x; i < count;
         i += (size_t)gridDim.x * blockDim.x)
        bad |= (__ldg(bits + i) & exponent) == exponent;
    return bad;
}

// Raises state->not_finite where anything of a level is NaN or infinite.
extern "C" __global__ void __launch_bounds__(256) all_finite(const FiniteArguments a) {
    const Level& level = *a.level;
    const size_t cells = (size_t)level.height * level.width, anchors = level.total;
    bool bad = any_not_finite(level.features, cells * CHANNELS);
    bad |= any_not_finite(level.anchor_features, anchors * CHANNELS);
    bad |= any_not_finite(level.confidence, cells);
    bad |= any_not_finite(level.anchor_confidence, anchors);
    bad |= any_not_finite(level.points, 3 * anchors);
    if (bad) a.state->not_finite = 1;
}
