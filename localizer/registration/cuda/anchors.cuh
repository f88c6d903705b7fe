// From anchors to the numbers of equations 1 to 4 and 7, one warp for 32 anchors at a time.
//
// A lane projects one anchor. Then the warp's lanes share the channels: LANES of them read one
// anchor's features, VECTOR channels each (16 bytes), and reduce them to S, b and |r|^2. Then each
// lane has its own anchor again. Nothing but warp shuffles and the warp's own shared memory is used.
#pragma once
#include "layout.cuh"

constexpr int VECTORS = (CHANNELS + VECTOR - 1) / VECTOR;

__host__ __device__ constexpr int lanes_for(int vectors) {
    int lanes = 1;
    while (2 * lanes <= vectors && 2 * lanes <= WARP) lanes *= 2;
    return lanes;
}

constexpr int LANES = lanes_for(VECTORS);                  // per anchor
constexpr int PER_LANE = (VECTORS + LANES - 1) / LANES;    // vectors of one lane
constexpr int GROUPS = WARP / LANES;                       // anchors at once
constexpr int REDUCED = 8;                                 // A, B, D, p, q, e and two zeros

constexpr int SUMS_PER_LANE = LANES < REDUCED ? REDUCED / LANES : 1;
constexpr int DUPLICATES = LANES > REDUCED ? LANES / REDUCED : 1;  // lanes with the same sum

// A pose as the anchors need it.
struct PoseF {
    float R[9], t[3];
};

// One anchor at one pose. S = [A B; B D], b = (p, q), e = |r|^2; weight: joint confidence.
struct Terms {
    bool visible;
    float x, y, z, u, v;
    float A, B, D, p, q, e, weight;
};

struct WarpScratch {
    float4 parameters[WARP];         // cell and reference (as bits), fractions ax and ay
    float4 sums[WARP * REDUCED / 4];
};

__device__ inline PoseF pose_of(const double* R, const double* t) {
    PoseF pose;
#pragma unroll
    for (int i = 0; i < 9; ++i) pose.R[i] = (float)R[i];
#pragma unroll
    for (int i = 0; i < 3; ++i) pose.t[i] = (float)t[i];
    return pose;
}

// Every step-th anchor is used, as `_thinned` of jngo.py does.
__device__ inline int step_for(int total, int wanted) {
    const int step = wanted > 0 ? total / wanted : 1;
    return step < 2 ? 1 : step;
}

__device__ inline void load(const float* from, float (&to)[VECTOR]) {
    if constexpr (VECTOR == 4) {
        const float4 f = __ldg(reinterpret_cast<const float4*>(from));
        to[0] = f.x;
        to[1] = f.y;
        to[2] = f.z;
        to[3] = f.w;
    } else {
        to[0] = __ldg(from);
    }
}

// Equation 1 and the test for the view.
__device__ inline void project(const Level& level, const PoseF& pose, int anchor, Terms& terms) {
    const float X = __ldg(level.points + anchor), Y = __ldg(level.points + level.total + anchor),
                Z = __ldg(level.points + 2 * level.total + anchor);
    const float *R = pose.R, *t = pose.t;
    terms.x = R[0] * X + R[1] * Y + R[2] * Z + t[0];
    terms.y = R[3] * X + R[4] * Y + R[5] * Z + t[1];
    terms.z = R[6] * X + R[7] * Y + R[8] * Z + t[2];
    const float inverse = 1.0f / fmaxf(terms.z, MIN_DEPTH);
    terms.u = level.fx * terms.x * inverse + level.cx;
    terms.v = level.fy * terms.y * inverse + level.cy;
    terms.visible = terms.u >= 0.0f && terms.u < (float)(level.width - 1) && terms.v >= 0.0f &&
                    terms.v < (float)(level.height - 1) && terms.z > MIN_DEPTH;
}

// Sums WIDTH values over 2 * STEP lanes: halves are exchanged, not copied, until a lane has one value;
// then values are exchanged whole. Returns the index of the lane's first sum.
template <int WIDTH, int STEP, int SIZE>
__device__ __forceinline__ int lane_sum(float (&s)[SIZE], int lane) {
    if constexpr (STEP == 0) {
        return 0;
    } else if constexpr (WIDTH == 1) {
        s[0] += __shfl_xor_sync(ALL, s[0], STEP);
        return lane_sum<1, STEP / 2>(s, lane);
    } else {
        constexpr int HALF = WIDTH / 2;
        const bool upper = lane & STEP;
#pragma unroll
        for (int i = 0; i < HALF; ++i) {
            const float keep = upper ? s[i + HALF] : s[i];
            const float send = upper ? s[i] : s[i + HALF];
            s[i] = keep + __shfl_xor_sync(ALL, send, STEP);
        }
        return (upper ? HALF : 0) + lane_sum<HALF, STEP / 2>(s, lane);
    }
}

// Terms of the anchor that this lane brings; all lanes of the warp call it together.
// anchor: index of the point, reference: whose features it is compared with; valid: false for a lane
// without an anchor.
__device__ inline Terms anchor_terms(const Level& level, const PoseF& pose, bool valid, int anchor,
                                     int reference, WarpScratch& scratch) {
    const int lane = threadIdx.x % WARP;
    Terms terms = {};
    if (valid) project(level, pose, anchor, terms);
    const unsigned mask = __ballot_sync(ALL, terms.visible);
    const int count = __popc(mask), slot = __popc(mask & ((1u << lane) - 1u));
    if (terms.visible) {
        const int column = (int)terms.u, row = (int)terms.v;
        const int cell = row * level.width + column;
        const float ax = terms.u - (float)column, ay = terms.v - (float)row;
        scratch.parameters[slot] =
            make_float4(__int_as_float(cell), __int_as_float(reference), ax, ay);
        const float *top = level.confidence + cell, *low = top + level.width;
        const float a = __ldg(top), b = __ldg(top + 1), c = __ldg(low), d = __ldg(low + 1);
        const float upper = a + ax * (b - a), lower = c + ax * (d - c);
        terms.weight = __ldg(level.anchor_confidence + anchor) * (upper + ay * (lower - upper));
    }
    __syncwarp();
    const int group = lane / LANES, part = lane % LANES;
    const size_t line = (size_t)level.width * CHANNELS;
    // `count` is the same in all lanes of the warp, so that they stay together.
    for (int base = 0; base < count; base += GROUPS * IN_FLIGHT) {
        float s[IN_FLIGHT][REDUCED] = {};
        float4 own[IN_FLIGHT];
#pragma unroll
        for (int i = 0; i < IN_FLIGHT; ++i)
            own[i] = scratch.parameters[min(base + i * GROUPS + group, count - 1)];
#pragma unroll
        for (int k = 0; k < PER_LANE; ++k) {
            const int channel = (k * LANES + part) * VECTOR;
            if (PER_LANE * LANES != VECTORS && channel >= CHANNELS) break;
            float f00[IN_FLIGHT][VECTOR], f01[IN_FLIGHT][VECTOR], f10[IN_FLIGHT][VECTOR],
                f11[IN_FLIGHT][VECTOR], fr[IN_FLIGHT][VECTOR];
#pragma unroll
            for (int i = 0; i < IN_FLIGHT; ++i) {
                const float* corner =
                    level.features + (size_t)__float_as_int(own[i].x) * CHANNELS + channel;
                load(corner, f00[i]);
                load(corner + CHANNELS, f01[i]);
                load(corner + line, f10[i]);
                load(corner + line + CHANNELS, f11[i]);
                load(level.anchor_features + (size_t)__float_as_int(own[i].y) * CHANNELS + channel,
                     fr[i]);
            }
#pragma unroll
            for (int i = 0; i < IN_FLIGHT; ++i) {
                const float ax = own[i].z, ay = own[i].w;
#pragma unroll
                for (int c = 0; c < VECTOR; ++c) {
                    const float d0 = f01[i][c] - f00[i][c], d1 = f11[i][c] - f10[i][c];
                    const float upper = f00[i][c] + ax * d0;
                    const float gy = f10[i][c] + ax * d1 - upper;
                    const float gx = d0 + ay * (d1 - d0);
                    const float r = upper + ay * gy - fr[i][c];
                    s[i][0] += gx * gx;
                    s[i][1] += gx * gy;
                    s[i][2] += gy * gy;
                    s[i][3] += gx * r;
                    s[i][4] += gy * r;
                    s[i][5] += r * r;
                }
            }
        }
#pragma unroll
        for (int i = 0; i < IN_FLIGHT; ++i) {
            const int first = lane_sum<REDUCED, LANES / 2>(s[i], lane);
            const int to = base + i * GROUPS + group;
            float* out = reinterpret_cast<float*>(scratch.sums) + to * REDUCED + first;
            if (to < count && part % DUPLICATES == 0) {
#pragma unroll
                for (int k = 0; k < SUMS_PER_LANE; ++k) out[k] = s[i][k];
            }
        }
    }
    __syncwarp();
    if (terms.visible) {
        const float4 low = scratch.sums[2 * slot], high = scratch.sums[2 * slot + 1];
        terms.A = low.x;
        terms.B = low.y;
        terms.D = low.z;
        terms.p = low.w;
        terms.q = high.x;
        terms.e = high.y;
    }
    // No barrier here: the next call writes the scratch behind its own ballot and barrier.
    return terms;
}

struct Loss {
    float cost, weight;
};

// Equation 4 of the squared residual norm e.
__device__ inline Loss robust(float e, float delta, bool redescending) {
    if (redescending) {
        const float share = 1.0f / (1.0f + e / (delta * delta));
        return {e * share, share * share};
    }
    const float norm = sqrtf(e);
    if (norm <= delta) return {e, 1.0f};
    return {delta * (2.0f * norm - delta), delta / norm};
}

// The two rows of equation 6.
__device__ inline void projection_rows(const Level& level, const PoseF& pose, const Terms& k,
                                       float (&U)[6], float (&V)[6]) {
    const float inverse = 1.0f / k.z;
    const float a = level.fx * inverse, c = level.fy * inverse;
    const float b = -a * k.x * inverse, d = -c * k.y * inverse;
    const float x = k.x - pose.t[0], y = k.y - pose.t[1], z = k.z - pose.t[2];
    U[0] = a;
    U[1] = 0.0f;
    U[2] = b;
    U[3] = b * y;
    U[4] = a * z - b * x;
    U[5] = -a * y;
    V[0] = 0.0f;
    V[1] = c;
    V[2] = d;
    V[3] = d * y - c * z;
    V[4] = -d * x;
    V[5] = c * x;
}

// Adds w Jt S J (lower triangle) and w Jt b of one anchor.
__device__ inline void add_normal_equations(const float (&U)[6], const float (&V)[6],
                                            const Terms& k, float w, float* hessian,
                                            float* gradient) {
    const float A = w * k.A, B = w * k.B, D = w * k.D, p = w * k.p, q = w * k.q;
#pragma unroll
    for (int i = 0; i < 6; ++i) {
        const float m = A * U[i] + B * V[i], n = B * U[i] + D * V[i];
#pragma unroll
        for (int j = 0; j <= i; ++j) hessian[i * (i + 1) / 2 + j] += m * U[j] + n * V[j];
        gradient[i] += p * U[i] + q * V[i];
    }
}

// Sums 32 values over the warp; afterwards lane i returns the sum of value i.
__device__ __forceinline__ float warp_sum(float (&values)[WARP]) {
    lane_sum<WARP, WARP / 2>(values, threadIdx.x % WARP);
    return values[0];
}
