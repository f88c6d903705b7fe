// What host and device agree on: layout.py describes the same structures to NumPy, and passes their
// sizes as options, so that a disagreement does not compile.
#pragma once

// Given by the compiler's options: CHANNELS, IN_FLIGHT, BYTES_OF_*.

constexpr int VECTOR = CHANNELS % 4 == 0 ? 4 : 1;

constexpr int WARP = 32;
constexpr unsigned ALL = 0xffffffffu;
constexpr float MIN_DEPTH = 0.1f;  // m

// One pyramid level of the query and the anchors as seen on it. Anchor i of the `total` has point
// (points[i], points[total + i], points[2 total + i]) in the local frame.
struct Level {
    const float* features;  // (height, width, CHANNELS)
    const float* confidence;  // (height, width)
    const float* points;
    const float* anchor_features;  // (total, CHANNELS)
    const float* anchor_confidence;
    int height, width, total, unused;
    float fx, fy, cx, cy;  // array index units
};

// Equation 15. Rotation and translation: camera_from_local.
struct Prior {
    double rotation[9], translation[3], information[36], weight;
};

// The motion term of equation 10; rotation and centre: world_from_camera. weight 0: none.
struct Motion {
    double rotation[9], centre[3], information[36], origin[3], weight;
};

// Hypotheses: camera_from_local, scores (infinite without overlap), anchors in view.
struct Swarm {
    double *rotations, *translations, *scores;
    int* visible;
};

// What kernels of one registration tell each other, and in the end the host.
struct State {
    double median, scale;  // residual norm of the winner; last scale that followed from it
    int count;             // hypotheses alive; 0: no overlap
    int evaluations;
    int not_finite;  // features, confidences or points hold NaN or infinity
    int cells;       // occupied cells of equation 11
    float quality;
    float total;       // sum of w
    float scale_sum;   // sum of w times the robust weight
    float square_sum;  // the same, times the squared residual norm
    float hessian[21], meat[21], isotropic[21];
    float unused;
};

struct RefineArguments {
    const Level* level;
    const Prior* prior;  // null: none
    State* state;
    Swarm swarm;
    double damping, damping_down, damping_up, min_overlap;
    double scale;   // of the loss; if factor > 0 it is max(factor * state->median, scale)
    double factor;
    int redescending, iterations, wanted, counted;  // wanted: about so many anchors; 0: all
};

struct SelectArguments {
    const Level* level;
    const Motion* motion;  // null: ordered by the cost alone
    State* state;
    Swarm from, to;
    double* totals;    // scratch (from's size)
    int* order;        // scratch, likewise
    int* alive;        // scratch, likewise
    float* projected;  // scratch, 2 * MAX_PROBES per hypothesis
    double distinct;   // px
    double least_score;
    int wanted, keep;
    int joining, unused;  // joining: the poses behind the last of from follow the survivors
};

struct PriorWeightArguments {
    Prior* prior;
    const State* state;
    const double* scores;
    double share, least_score;
    int limit, unused;  // of the hypotheses alive, the first so many
};

struct WinnerArguments {
    const Level* level;
    State* state;
    Swarm swarm;     // the winner is its first
    float* scratch;  // 8 floats per anchor that takes part
    double scale;    // of the loss, unless redescending: then it is state->scale
    float cell;      // array index units
    int redescending, wanted, unused;
};

struct FiniteArguments {
    const Level* level;
    State* state;
};

#define SAME_SIZE(name) static_assert(sizeof(name) == BYTES_OF_##name, "layout.py differs: " #name)
SAME_SIZE(Level);
SAME_SIZE(Prior);
SAME_SIZE(Motion);
SAME_SIZE(State);
SAME_SIZE(RefineArguments);
SAME_SIZE(SelectArguments);
SAME_SIZE(PriorWeightArguments);
SAME_SIZE(WinnerArguments);
SAME_SIZE(FiniteArguments);
