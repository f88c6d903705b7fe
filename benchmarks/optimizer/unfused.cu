// The plain port that the paper's Table 7 calls "CUDA Port": one kernel per step of the mathematics,
// every intermediate in global memory, C x 6 Jacobians, atomic sums. For comparison only.
#ifdef CUDA_EMULATION
inline float atomicAdd(float* to, float value) { float old = *to; *to += value; return old; }
#endif

struct UnfusedArguments {
    const float *features, *confidence, *points, *anchor_features, *anchor_confidence;
    const float *rotations, *translations;  // (M, 9), (M, 3)
    float *camera_points, *pixels;          // (M, N, 3), (M, N, 2)
    float *residuals, *gradients;           // (M, N, C), (M, N, C, 2)
    float *jacobians, *weights;             // (M, N, C, 6), (M, N)
    float *sums, *steps;                    // (M, 28): 21 of H, 6 of g, weight; (M, 6)
    int height, width, anchors, hypotheses;
    float fx, fy, cx, cy, huber, damping;
};

#define FOR_EACH(index, count)                                         \
    for (int index = blockIdx.x * blockDim.x + threadIdx.x; index < (count); \
         index += gridDim.x * blockDim.x)

extern "C" __global__ void unfused_project(const UnfusedArguments a) {
    FOR_EACH(i, a.hypotheses * a.anchors) {
        const int m = i / a.anchors, n = i % a.anchors;
        const float *R = a.rotations + 9 * m, *t = a.translations + 3 * m;
        const float X = a.points[n], Y = a.points[a.anchors + n], Z = a.points[2 * a.anchors + n];
        float* x = a.camera_points + 3 * (size_t)i;
        for (int k = 0; k < 3; ++k) x[k] = R[3 * k] * X + R[3 * k + 1] * Y + R[3 * k + 2] * Z + t[k];
        const float inverse = 1.0f / fmaxf(x[2], 0.1f);
        a.pixels[2 * (size_t)i] = a.fx * x[0] * inverse + a.cx;
        a.pixels[2 * (size_t)i + 1] = a.fy * x[1] * inverse + a.cy;
        for (int k = 0; k < 28 && n == 0; ++k) a.sums[28 * m + k] = 0.0f;
    }
}

extern "C" __global__ void unfused_sample(const UnfusedArguments a) {
    FOR_EACH(j, a.hypotheses * a.anchors * CHANNELS) {
        const int i = j / CHANNELS, c = j % CHANNELS, n = i % a.anchors;
        const float u = a.pixels[2 * (size_t)i], v = a.pixels[2 * (size_t)i + 1];
        const bool inside = u >= 0.0f && u < a.width - 1 && v >= 0.0f && v < a.height - 1 &&
                            a.camera_points[3 * (size_t)i + 2] > 0.1f;
        const int column = inside ? (int)u : 0, row = inside ? (int)v : 0;
        const float ax = inside ? u - column : 0.0f, ay = inside ? v - row : 0.0f;
        const size_t cell = (size_t)row * a.width + column;
        const float* f = a.features + cell * CHANNELS + c;
        const float f00 = f[0], f01 = f[CHANNELS], f10 = f[a.width * CHANNELS],
                    f11 = f[(a.width + 1) * CHANNELS];
        const float top = f00 + ax * (f01 - f00), low = f10 + ax * (f11 - f10);
        a.residuals[j] = top + ay * (low - top) - a.anchor_features[n * CHANNELS + c];
        a.gradients[2 * (size_t)j] = (f01 - f00) * (1.0f - ay) + (f11 - f10) * ay;
        a.gradients[2 * (size_t)j + 1] = low - top;
        if (c == 0) {
            const float* w = a.confidence + cell;
            const float upper = w[0] + ax * (w[1] - w[0]);
            const float lower = w[a.width] + ax * (w[a.width + 1] - w[a.width]);
            a.weights[i] = inside ? a.anchor_confidence[n] * (upper + ay * (lower - upper)) : 0.0f;
        }
    }
}

extern "C" __global__ void unfused_jacobian(const UnfusedArguments a) {
    FOR_EACH(j, a.hypotheses * a.anchors * CHANNELS) {
        const int i = j / CHANNELS, m = i / a.anchors;
        const float *x = a.camera_points + 3 * (size_t)i, *t = a.translations + 3 * m;
        const float z = fmaxf(x[2], 0.1f), A = a.fx / z, B = -a.fx * x[0] / (z * z), C = a.fy / z,
                    D = -a.fy * x[1] / (z * z);
        const float X = x[0] - t[0], Y = x[1] - t[1], Z = x[2] - t[2];
        const float U[6] = {A, 0.0f, B, B * Y, A * Z - B * X, -A * Y};
        const float V[6] = {0.0f, C, D, D * Y - C * Z, -D * X, C * X};
        for (int k = 0; k < 6; ++k)
            a.jacobians[6 * (size_t)j + k] =
                a.gradients[2 * (size_t)j] * U[k] + a.gradients[2 * (size_t)j + 1] * V[k];
    }
}

extern "C" __global__ void unfused_accumulate(const UnfusedArguments a) {
    FOR_EACH(i, a.hypotheses * a.anchors) {
        const int m = i / a.anchors;
        float H[21] = {}, g[6] = {}, squared = 0.0f;
        for (int c = 0; c < CHANNELS; ++c) {
            const float* J = a.jacobians + 6 * ((size_t)i * CHANNELS + c);
            const float r = a.residuals[(size_t)i * CHANNELS + c];
            squared += r * r;
            for (int k = 0, e = 0; k < 6; ++k) {
                g[k] += J[k] * r;
                for (int l = 0; l <= k; ++l) H[e++] += J[k] * J[l];
            }
        }
        const float norm = sqrtf(squared), joint = a.weights[i];
        const float w = joint * (norm <= a.huber ? 1.0f : a.huber / norm);
        for (int e = 0; e < 21; ++e) atomicAdd(a.sums + 28 * m + e, w * H[e]);
        for (int k = 0; k < 6; ++k) atomicAdd(a.sums + 28 * m + 21 + k, w * g[k]);
        atomicAdd(a.sums + 28 * m + 27, joint);
    }
}

extern "C" __global__ void unfused_solve(const UnfusedArguments a) {
    FOR_EACH(m, a.hypotheses) {
        const float* sums = a.sums + 28 * m;
        float L[21], step[6];
        for (int i = 0; i < 6; ++i)
            for (int j = 0; j <= i; ++j) {
                float s = sums[i * (i + 1) / 2 + j];
                if (i == j) s *= 1.0f + a.damping;
                for (int k = 0; k < j; ++k) s -= L[i * (i + 1) / 2 + k] * L[j * (j + 1) / 2 + k];
                L[i * (i + 1) / 2 + j] = i == j ? sqrtf(s) : s / L[j * (j + 1) / 2 + j];
            }
        for (int i = 0; i < 6; ++i) {
            float s = -sums[21 + i];
            for (int k = 0; k < i; ++k) s -= L[i * (i + 1) / 2 + k] * step[k];
            step[i] = s / L[i * (i + 1) / 2 + i];
        }
        for (int i = 5; i >= 0; --i) {
            float s = step[i];
            for (int k = i + 1; k < 6; ++k) s -= L[k * (k + 1) / 2 + i] * step[k];
            step[i] = s / L[i * (i + 1) / 2 + i];
            a.steps[6 * m + i] = step[i];
        }
    }
}
