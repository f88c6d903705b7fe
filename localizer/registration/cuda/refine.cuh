// Levenberg-Marquardt with accept and reject: one block refines one hypothesis through all its
// iterations (equations 7 to 9). Warp 0 solves the 6x6 system and moves the pose.
#pragma once
#include "anchors.cuh"
#include "pose.cuh"

constexpr int COST = 27, WEIGHT = 28, VISIBLE = 29;  // behind 21 of H and 6 of g

template <int WARPS>
struct BlockScratch {
    WarpScratch warps[WARPS];
    float partial[WARPS][WARP];
    double sums[WARP];
};

// Sums each of 32 values over the block, in an order that depends on nothing but the block's size.
// Warp 0 may read scratch.sums afterwards; the other threads after a barrier. The caller puts a
// barrier between this and the next call.
template <int WARPS>
__device__ inline void block_sum(float (&values)[WARP], BlockScratch<WARPS>& scratch) {
    const int lane = threadIdx.x % WARP, warp = threadIdx.x / WARP;
    scratch.partial[warp][lane] = warp_sum(values);
    __syncthreads();
    if (warp == 0) {
        double sum = 0.0;
        for (int w = 0; w < (int)blockDim.x / WARP; ++w) sum += (double)scratch.partial[w][lane];
        scratch.sums[lane] = sum;
        __syncwarp();
    }
}

// One hypothesis: the pose that is evaluated, and the best so far with its normal equations.
template <int WARPS>
struct RefineScratch {
    BlockScratch<WARPS> block;
    PoseF pose;  // the trial pose as the anchors need it
    double R[9], t[3], R_trial[9], t_trial[3], best[27], step[6], damped[21];
    PriorScratch prior;
    double score, damping;
    int visible, go;
};

// Equations 1 to 4 and 7 at `pose`, summed into scratch.block.sums for warp 0.
template <int WARPS>
__device__ inline void evaluate(const Level& level, int step, int count, float delta,
                                bool redescending, RefineScratch<WARPS>& scratch) {
    const PoseF pose = scratch.pose;
    float sums[WARP] = {};
    for (int base = 0; base < count; base += blockDim.x) {
        const int index = base + threadIdx.x;
        const Terms k = anchor_terms(level, pose, index < count, index * step, index * step,
                                     scratch.block.warps[threadIdx.x / WARP]);
        if (!k.visible) continue;
        const Loss loss = robust(k.e, delta, redescending);
        float U[6], V[6];
        projection_rows(level, pose, k, U, V);
        add_normal_equations(U, V, k, k.weight * loss.weight, sums, sums + 21);
        sums[COST] += k.weight * loss.cost;
        sums[WEIGHT] += k.weight;
        sums[VISIBLE] += 1.0f;
    }
    block_sum(sums, scratch.block);
}

// By warp 0: means of the sums, with the prior; the trial's score, infinite where there is none.
template <int WARPS>
__device__ inline double conclude(const Prior* prior, int least, RefineScratch<WARPS>& s) {
    double* sums = s.block.sums;
    const int lane = threadIdx.x;
    const double infinite = __longlong_as_double(0x7ff0000000000000LL);
    const double weight = sums[WEIGHT], visible = sums[VISIBLE];
    if (!(visible >= (double)least) || !(weight > 0.0)) return infinite;
    const double score = sums[COST] / weight;
    if (lane < 27) sums[lane] /= weight;  // read again by the same lane
    double total = score;
    if (prior && prior->weight > 0.0) {
        add_prior(*prior, s.R_trial, s.t_trial, sums, s.prior);
        total += s.prior.cost;
    }
    return total < infinite ? total : infinite;
}

// By warp 0: the trial becomes the best.
template <int WARPS>
__device__ inline void accept(RefineScratch<WARPS>& s, double score) {
    const int lane = threadIdx.x;
    if (lane < 27) s.best[lane] = s.block.sums[lane];
    if (lane < 9) s.R[lane] = s.R_trial[lane];
    if (lane < 3) s.t[lane] = s.t_trial[lane];
    if (lane == 0) {
        s.score = score;
        s.visible = (int)s.block.sums[VISIBLE];
    }
    __syncwarp();
}

// By warp 0: judges the trial and makes the next one (equations 8 and 9); false ends the iterations.
template <int WARPS>
__device__ inline bool advance(const RefineArguments& a, int least, int iteration,
                               RefineScratch<WARPS>& s) {
    const double score = conclude(a.prior, least, s), before = s.score;
    const int lane = threadIdx.x;
    const bool better = iteration == 0 || score < before;
    double damping = s.damping;
    if (iteration > 0) damping *= better ? a.damping_down : a.damping_up;
    __syncwarp();
    if (better) accept(s, score);
    if (iteration == 0 && !(score < __longlong_as_double(0x7ff0000000000000LL))) return false;
    double component;
    if (iteration == a.iterations || !damped_step(s.best, s.t, damping, s.damped, component))
        return false;
    if (lane < 6) s.step[lane] = component;
    __syncwarp();
    if (lane == 0) {
        s.damping = damping;
        retract(s.R, s.t, s.step, s.R_trial, s.t_trial);
        s.pose = pose_of(s.R_trial, s.t_trial);
    }
    return true;
}

template <int WARPS>
__device__ inline void refine_hypothesis(const RefineArguments& a, RefineScratch<WARPS>& s) {
    const int m = blockIdx.x;
    if (m >= a.state->count) return;
    const Level level = *a.level;
    const int step = step_for(level.total, a.wanted), count = (level.total + step - 1) / step;
    const int least = max(6, (int)ceil(a.min_overlap * (double)count));
    const bool first = threadIdx.x == 0, redescending = a.redescending;
    const double scale = a.factor > 0.0 ? fmax(a.factor * a.state->median, a.scale) : a.scale;
    int evaluations = 0;
    if (first) {
        for (int i = 0; i < 9; ++i) s.R_trial[i] = a.swarm.rotations[9 * m + i];
        for (int i = 0; i < 3; ++i) s.t_trial[i] = a.swarm.translations[3 * m + i];
        s.pose = pose_of(s.R_trial, s.t_trial);
        s.damping = a.damping;
    }
    __syncthreads();
    for (int iteration = 0;; ++iteration) {
        evaluate(level, step, count, (float)scale, redescending, s);
        if (threadIdx.x < WARP) {
            const bool go = advance(a, least, iteration, s);
            if (first) s.go = go;
        }
        ++evaluations;
        __syncthreads();
        if (!s.go) break;
    }
    if (!first) return;
    for (int i = 0; i < 9; ++i) a.swarm.rotations[9 * m + i] = s.R[i];
    for (int i = 0; i < 3; ++i) a.swarm.translations[3 * m + i] = s.t[i];
    a.swarm.scores[m] = s.score;
    a.swarm.visible[m] = s.visible;
    if (a.counted) atomicAdd(&a.state->evaluations, evaluations);
    if (m == 0 && a.factor > 0.0) a.state->scale = scale;
}

// Many hypotheses: two blocks of 256 threads per multiprocessor.
extern "C" __global__ void __launch_bounds__(256, 2) refine_many(const RefineArguments a) {
    __shared__ RefineScratch<8> scratch;
    refine_hypothesis(a, scratch);
}

// Few hypotheses with many anchors: one large block each.
extern "C" __global__ void __launch_bounds__(512, 1) refine_few(const RefineArguments a) {
    __shared__ RefineScratch<16> scratch;
    refine_hypothesis(a, scratch);
}
