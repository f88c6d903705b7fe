// Float64 mathematics of one pose: equations 5, 8, 13 and 15 of docs/explanation/registration.md.
#pragma once
#include "layout.cuh"

// Index of (row, column), row >= column, in a lower triangle stored by rows.
__device__ constexpr int triangle(int row, int column) { return row * (row + 1) / 2 + column; }

// The left side of equation 8, by one thread, into the lower triangle M; sums: 21 of H, then g.
__device__ inline void damp(const double* sums, const double* t, double damping, double* M) {
    const double x = t[0], y = t[1], z = t[2];
#pragma unroll
    for (int k = 0; k < 21; ++k) M[k] = sums[k];
    // What a turn about the camera's centre is worth: the diagonal of equation 8a.
    const double turn0 = M[9] + z * z * M[2] + y * y * M[5] +
                         2.0 * (y * M[8] - z * M[7] - y * z * M[4]);
    const double turn1 = M[14] + z * z * M[0] + x * x * M[5] +
                         2.0 * (z * M[10] - x * M[12] - x * z * M[3]);
    const double turn2 = M[20] + y * y * M[0] + x * x * M[2] +
                         2.0 * (x * M[16] - y * M[15] - x * y * M[1]);
    const double a = damping * M[0], b = damping * M[2], c = damping * M[5];
    M[0] += a;
    M[2] += b;
    M[5] += c;
    M[7] += b * z;
    M[8] -= c * y;
    M[10] -= a * z;
    M[12] += c * x;
    M[15] += a * y;
    M[16] -= b * x;
    M[9] += damping * turn0 + b * z * z + c * y * y;
    M[14] += damping * turn1 + a * z * z + c * x * x;
    M[20] += damping * turn2 + a * y * y + b * x * x;
    M[13] -= c * x * y;
    M[18] -= b * x * z;
    M[19] -= a * y * z;
}

// Equation 8, by one warp: lane i < 6 holds row i of the unit-diagonal system and eliminates. The
// pivots are the squares of Cholesky's diagonal, so the system is positive definite where they are
// positive; false elsewhere. sums: 21 of H, then 6 of g; M: scratch of 21. All lanes return
// component i (lane % 8 < 6).
__device__ inline bool damped_step(const double* sums, const double* t, double damping, double* M,
                                   double& component) {
    const int i = min((int)threadIdx.x % 8, 5);
    if (__ballot_sync(ALL, !(sums[triangle(i, i)] > 0.0))) return false;
    if (threadIdx.x % WARP == 0) damp(sums, t, damping, M);
    __syncwarp();
    const double diagonal = M[triangle(i, i)];
    if (__ballot_sync(ALL, !(diagonal > 0.0))) return false;
    const double scale = 1.0 / sqrt(diagonal);
    double row[6], right = -sums[21 + i] * scale;
#pragma unroll
    for (int j = 0; j < 6; ++j) {
        const double entry = M[i > j ? triangle(i, j) : triangle(j, i)];
        row[j] = entry * scale * __shfl_sync(ALL, scale, j);
    }
#pragma unroll
    for (int k = 0; k < 6; ++k) {
        const double pivot = __shfl_sync(ALL, row[k], k);
        if (!(pivot > 0.0)) return false;
        const double factor = i == k ? 0.0 : row[k] / pivot;
        right -= factor * __shfl_sync(ALL, right, k);
#pragma unroll
        for (int j = k; j < 6; ++j) row[j] -= factor * __shfl_sync(ALL, row[j], k);
    }
    double own = row[0];
#pragma unroll
    for (int j = 1; j < 6; ++j) own = i == j ? row[j] : own;
    component = right / own * scale;
    return true;
}

// Equation 5, by one thread: R_out = exp(phi) R, t_out = t + rho. The quaternion of a turn of at most
// half a radian is summed as a series, exact to 1e-17, and squared as often as it was halved: sine
// and cosine of any double would cost local memory.
__device__ inline void retract(const double* R, const double* t, const double* step, double* R_out,
                               double* t_out) {
    double x = step[3], y = step[4], z = step[5];
    double angle2 = x * x + y * y + z * z;
    int halvings = 0;
    for (; angle2 > 0.25 && halvings < 32; ++halvings) {
        angle2 *= 0.25;
        x *= 0.5;
        y *= 0.5;
        z *= 0.5;
    }
    const double h = 0.25 * angle2;  // squared half angle
    double w = 1.0 - h / 2 * (1.0 - h / 12 * (1.0 - h / 30 * (1.0 - h / 56 * (1.0 - h / 90))));
    const double s =
        0.5 * (1.0 - h / 6 * (1.0 - h / 20 * (1.0 - h / 42 * (1.0 - h / 72 * (1.0 - h / 110)))));
    x *= s;
    y *= s;
    z *= s;
    for (; halvings > 0; --halvings) {
        const double twice = 2.0 * w;
        w = w * w - (x * x + y * y + z * z);
        x *= twice;
        y *= twice;
        z *= twice;
    }
    const double unit = 2.0 / (w * w + x * x + y * y + z * z);
    const double E[9] = {1.0 - unit * (y * y + z * z), unit * (x * y - w * z), unit * (x * z + w * y),
                         unit * (x * y + w * z), 1.0 - unit * (x * x + z * z), unit * (y * z - w * x),
                         unit * (x * z - w * y), unit * (y * z + w * x), 1.0 - unit * (x * x + y * y)};
#pragma unroll
    for (int i = 0; i < 3; ++i) {
#pragma unroll
        for (int j = 0; j < 3; ++j)
            R_out[3 * i + j] = E[3 * i] * R[j] + E[3 * i + 1] * R[3 + j] + E[3 * i + 2] * R[6 + j];
        t_out[i] = t[i] + step[i];
    }
}

// Rotation vector of R for angles below pi (equation 13).
__device__ inline void rotation_vector(const double* R, double* out) {
    const double c = fmin(1.0, fmax(-1.0, 0.5 * (R[0] + R[4] + R[8] - 1.0)));
    out[0] = R[7] - R[5];
    out[1] = R[2] - R[6];
    out[2] = R[3] - R[1];
    const double s = 0.5 * sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2]);
    const double factor = s < 1e-12 ? 0.5 : 0.5 * atan2(s, c) / s;
#pragma unroll
    for (int i = 0; i < 3; ++i) out[i] *= factor;
}

struct PriorScratch {
    double d[6], J[36], Ld[6], LJ[36], cost;
};

// Equation 15, by one warp: adds the prior to the sums of H and g; its cost is left in the scratch.
__device__ inline void add_prior(const Prior& prior, const double* R, const double* t, double* sums,
                                 PriorScratch& s) {
    const int lane = threadIdx.x % WARP;
    const double *R0 = prior.rotation, *t0 = prior.translation;
    for (int k = lane; k < 36; k += WARP) s.J[k] = 0.0;
    __syncwarp();
    if (lane == 0) {
        double relative[9];
#pragma unroll
        for (int i = 0; i < 3; ++i)
#pragma unroll
            for (int j = 0; j < 3; ++j)
                relative[3 * i + j] = R[i] * R0[j] + R[3 + i] * R0[3 + j] + R[6 + i] * R0[6 + j];
        rotation_vector(relative, s.d + 3);
    }
    if (lane < 3) {  // row `lane` of equation 12, and of the position's difference
        const int i = lane;
        double difference = 0.0;
        for (int k = 0; k < 3; ++k) {
            difference += R0[3 * k + i] * t0[k] - R[3 * k + i] * t[k];
            s.J[6 * i + k] = -R[3 * k + i];
            s.J[6 * (3 + i) + 3 + k] = -R[3 * k + i];
        }
        s.d[i] = difference;
        s.J[6 * i + 3] = -(R[3 + i] * t[2] - R[6 + i] * t[1]);
        s.J[6 * i + 4] = -(R[6 + i] * t[0] - R[i] * t[2]);
        s.J[6 * i + 5] = -(R[i] * t[1] - R[3 + i] * t[0]);
    }
    __syncwarp();
    for (int entry = lane; entry < 42; entry += WARP) {  // information times d, and times J
        const int row = entry / 7, column = entry % 7;
        double sum = 0.0;
        for (int k = 0; k < 6; ++k)
            sum += prior.information[6 * row + k] * (column == 6 ? s.d[k] : s.J[6 * k + column]);
        if (column == 6)
            s.Ld[row] = sum;
        else
            s.LJ[6 * row + column] = sum;
    }
    __syncwarp();
    if (lane < 27) {
        int row = lane - 21, column = 0;
        if (lane < 21)
            for (row = 0; triangle(row + 1, 0) <= lane; ++row) {}
        if (lane < 21) column = lane - triangle(row, 0);
        double sum = 0.0;
        for (int k = 0; k < 6; ++k)
            sum += s.J[6 * k + row] * (lane < 21 ? s.LJ[6 * k + column] : s.Ld[k]);
        sums[lane] += prior.weight * sum;
    } else if (lane == 27) {
        double sum = 0.0;
        for (int k = 0; k < 6; ++k) sum += s.d[k] * s.Ld[k];
        s.cost = prior.weight * sum;
    }
    __syncwarp();
}
