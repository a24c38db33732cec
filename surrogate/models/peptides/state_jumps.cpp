// States of torsions drawn one after the other, by the arithmetic of `StateJumps.draw`: torch takes some ten microseconds
// for each of its small operations, many times what their numbers take.
#include <math.h>
#include <stdint.h>
#include <string.h>
#include <vector>

enum { ONES = STATES * TORSIONS, HIDDEN = 4 * WIDTH, DIM = WIDTH / HEADS };

// Weights as torch keeps them, (out, in).
struct Linear {
    const float *weight, *bias;
};
struct Block {
    const float *offset;
    Linear proj_in, attention_out, mlp_out;
};
struct Net {
    int64_t n_residues, coupled;
    const int64_t *counts;          // (residues, TORSIONS)
    Linear given[3], before[3], earlier, beside[3], fresh[TORSIONS], hidden, logits;
    const float *torsion;           // (TORSIONS, WIDTH)
    const float *types, *distances; // (residues, WIDTH), and (HEADS, residues, residues) where `coupled`
    Block blocks[BLOCKS];
};

template <int N> static inline float dot(const float *a, const float *b) {
    float sum = 0;
#pragma omp simd reduction(+ : sum)
    for (int i = 0; i < N; ++i) sum += a[i] * b[i];
    return sum;
}

// Rows x (n, IN) -> y (n, n_out).
template <int IN> static void apply(const Linear &l, const float *x, float *y, int64_t n, int n_out) {
    for (int o = 0; o < n_out; ++o) {
        const float *weight = l.weight + o * IN, bias = l.bias ? l.bias[o] : 0;
        for (int64_t k = 0; k < n; ++k) y[k * n_out + o] = bias + dot<IN>(x + k * IN, weight);
    }
}

// Itself, the residue before, the one after.
static const int PLACES[] = {0, -1, 1};

// Fast mathematics divides by no infinity.
static float sigmoid(float x) { return 1 / (1 + expf(fminf(-x, 80))); }
static float silu(float x) { return x * sigmoid(x); }
static float gelu(float x) { return x * sigmoid(2 * 0.7978845608028654f * (x + 0.044715f * x * x * x)); }

// Adds to h (WIDTH) what the first torsions of residue `r` tell by their states; a residue beyond the ends tells nothing.
static void add(float *h, const Linear &l, const Net &net, const int64_t *states, int64_t r, int torsions = TORSIONS) {
    if (r < 0 || r >= net.n_residues) return;
    for (int k = 0; k < torsions; ++k) {
        if (!net.counts[r * TORSIONS + k]) continue;
        const float *column = l.weight + k * STATES + states[r * TORSIONS + k];
        for (int i = 0; i < WIDTH; ++i) h[i] += column[i * ONES];
    }
}

// Attention over the residues of each row and the MLP beside it, as `ParallelBlock` without rotation: h (rows, residues,
// WIDTH) in place.
static void pass(const Net &net, const Block &block, std::vector<float> &h, std::vector<float> &work) {
    const int64_t n = net.n_residues, all = h.size() / WIDTH;
    const int wide = 3 * WIDTH + HIDDEN;
    work.resize(all * (WIDTH + wide + HIDDEN + 3 * WIDTH) + n);
    float *x = work.data(), *projected = x + all * WIDTH, *mlp = projected + all * wide, *attended = mlp + all * HIDDEN;
    float *one = attended + all * WIDTH, *two = one + all * WIDTH, *score = two + all * WIDTH;
    const float *shift = block.offset, *scale = shift + WIDTH, *gate = scale + WIDTH;
    for (int64_t k = 0; k < all; ++k) {
        const float *from = &h[k * WIDTH];
        float mean = 0, square = 0;
        for (int i = 0; i < WIDTH; ++i) mean += from[i] / WIDTH;
        for (int i = 0; i < WIDTH; ++i) square += (from[i] - mean) * (from[i] - mean) / WIDTH;
        const float by = 1 / sqrtf(square + 1e-5f);
        for (int i = 0; i < WIDTH; ++i) x[k * WIDTH + i] = shift[i] + (from[i] - mean) * by * (1 + scale[i]);
    }
    apply<WIDTH>(block.proj_in, x, projected, all, wide);
    for (int64_t k = 0; k < all; ++k) {
        float *own = projected + k * wide;
        for (int head = 0; head < 2 * HEADS; ++head) {
            float *qk = own + head * DIM;
            const float by = 1 / sqrtf(dot<DIM>(qk, qk) / DIM + 1e-6f);
            for (int i = 0; i < DIM; ++i) qk[i] *= by;
        }
        for (int i = 0; i < HIDDEN; ++i) mlp[k * HIDDEN + i] = gelu(own[3 * WIDTH + i]);
    }
    memset(attended, 0, sizeof(float) * all * WIDTH);
    for (int64_t k = 0; k < all; ++k)
        for (int head = 0; head < HEADS; ++head) {
            const float *keys = projected + k / n * n * wide + WIDTH + head * DIM, *values = keys + WIDTH;
            float most = -1e30f, sum = 0, *into = attended + k * WIDTH + head * DIM;
            for (int64_t j = 0; j < n; ++j) {
                score[j] = dot<DIM>(projected + k * wide + head * DIM, keys + j * wide) / sqrtf(DIM);
                score[j] += net.distances[(head * n + k % n) * n + j];
                most = fmaxf(most, score[j]);
            }
            for (int64_t j = 0; j < n; ++j) sum += score[j] = expf(fmaxf(score[j] - most, -80));
            for (int64_t j = 0; j < n; ++j)
                for (int i = 0; i < DIM; ++i) into[i] += score[j] / sum * values[j * wide + i];
        }
    apply<WIDTH>(block.attention_out, attended, one, all, WIDTH);
    apply<HIDDEN>(block.mlp_out, mlp, two, all, WIDTH);
    for (int64_t k = 0; k < all * WIDTH; ++k) h[k] += gate[k % WIDTH] * (one[k] + two[k]);
}

// Return the state that a number in [0, 1) draws by `logits` of `count` states.
static int64_t drawn(const float *logits, int64_t count, float uniform) {
    float shares[STATES], sum = 0, most = logits[0], share = 0;
    int64_t state = 0;
    for (int j = 1; j < count; ++j) most = fmaxf(most, logits[j]);
    for (int j = 0; j < count; ++j) sum += shares[j] = expf(fmaxf(logits[j] - most, -80));
    for (int j = 0; j + 1 < count; ++j) state += uniform >= (share += shares[j] / sum);
    return state;
}

// `common` (rows, frames, residues, WIDTH): what `of_times_alone` and `of_observed` add up to, the latter left out where
// `apart`: then it follows for each frame from the states of the one before. `levels` (rows, frames, TORSIONS, residues,
// STATES, STATES), `given` (rows, residues, TORSIONS), `uniform` and `out` (rows, frames, residues, TORSIONS).
extern "C" void draw(
    const Net *whole, int64_t rows, int64_t frames, int64_t apart, const float *common, const float *levels,
    const int64_t *given, const float *uniform, int64_t *out
) {
    const Net &net = *whole;
    const int64_t n = net.n_residues, size = n * TORSIONS, wide = n * WIDTH;
    std::vector<float> h(rows * wide), x(rows * wide), y(rows * wide), logits(rows * n * STATES), work;
    std::vector<int64_t> items;
    memset(out, 0, sizeof(int64_t) * rows * frames * size);
    for (int64_t frame = 0; frame < frames; ++frame) {
        auto before = [&](int64_t row, int64_t by) {
            return frame < by ? given + row * size : out + (row * frames + frame - by) * size;
        };
        memset(h.data(), 0, sizeof(float) * h.size());
        if (apart) {
            for (int64_t row = 0; row < rows; ++row) {
                memcpy(&h[row * wide], net.types, sizeof(float) * wide);
                for (int64_t r = 0; r < n; ++r)
                    for (int j = 0; j < 3; ++j)
                        add(&h[row * wide + r * WIDTH], net.given[j], net, before(row, 1), r + PLACES[j]);
            }
            for (int b = 0; b < BLOCKS && net.coupled; ++b) pass(net, net.blocks[b], h, work);
        }
        for (int64_t row = 0; row < rows; ++row) {
            const float *from = common + (row * frames + frame) * wide;
            for (int64_t i = 0; i < wide; ++i) h[row * wide + i] += from[i];
            for (int64_t r = 0; r < n; ++r) {
                float *own = &h[row * wide + r * WIDTH];
                for (int j = 0; j < 3; ++j) add(own, net.before[j], net, before(row, 1), r + PLACES[j]);
                // The first frame knows none before the given one, and so does each that follows from states alone.
                add(own, net.earlier, net, before(row, apart ? 1 : 2), r);
            }
        }
        // Without coupling no residue sees another's new states, and all are drawn at once, a torsion after the other.
        const int64_t parts = net.coupled ? n : 1;
        for (int64_t part = 0; part < parts; ++part)
            for (int torsion = 0; torsion < TORSIONS; ++torsion) {
                // Every other residue first.
                const int64_t half = (n + 1) / 2, one = part < half ? 2 * part : 2 * (part - half) + 1;
                items.clear();
                for (int64_t row = 0; row < rows; ++row)
                    for (int64_t r = net.coupled ? one : 0; r < (net.coupled ? one + 1 : n); ++r) {
                        if (!net.counts[r * TORSIONS + torsion]) continue;
                        const int64_t *fresh = before(row, 0);
                        float *own = &x[items.size() * WIDTH];
                        items.push_back(row * n + r);
                        for (int i = 0; i < WIDTH; ++i)
                            own[i] = h[row * wide + r * WIDTH + i] + net.torsion[torsion * WIDTH + i];
                        for (int j = 1; j < 3 && part >= half; ++j)
                            add(own, net.beside[j - 1], net, fresh, r + PLACES[j]);
                        if (net.coupled) add(own, net.beside[2], net, fresh, r - 2);
                        add(own, net.fresh[torsion], net, fresh, r, torsion);
                        for (int i = 0; i < WIDTH; ++i) own[i] = silu(own[i]);
                    }
                const int64_t n_items = items.size();
                apply<WIDTH>(net.hidden, x.data(), y.data(), n_items, WIDTH);
                for (int64_t i = 0; i < n_items * WIDTH; ++i) y[i] = silu(y[i]);
                apply<WIDTH>(net.logits, y.data(), logits.data(), n_items, STATES);
                for (int64_t item = 0; item < n_items; ++item) {
                    const int64_t row = items[item] / n, r = items[item] % n, place = r * TORSIONS + torsion;
                    const int64_t now = before(row, 1)[place], k = row * frames + frame;
                    const float *level = levels + (((k * TORSIONS + torsion) * n + r) * STATES + now) * STATES;
                    float *own = &logits[item * STATES];
                    // To stay has the logit zero.
                    for (int j = 0; j < STATES; ++j) own[j] = j == now ? 0 : own[j] + level[j];
                    out[k * size + place] = drawn(own, net.counts[place], uniform[k * size + place]);
                }
            }
    }
}
