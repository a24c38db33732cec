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
    Linear given[3], before[3], earlier, beside[2], fresh[TORSIONS], hidden, logits;
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

// Draws a state by `logits` of `count` and a number in [0, 1), or takes the one that it is given where there is none;
// adds the logarithm of its probability.
static int64_t taken(const float *logits, int64_t count, const float *uniform, int64_t state, double *log_probability) {
    float shares[STATES], sum = 0, most = logits[0], share = 0;
    for (int j = 1; j < count; ++j) most = fmaxf(most, logits[j]);
    for (int j = 0; j < count; ++j) sum += shares[j] = expf(fmaxf(logits[j] - most, -80));
    if (uniform) {
        state = 0;
        for (int j = 0; j + 1 < count; ++j) state += *uniform >= (share += shares[j] / sum);
    }
    *log_probability += logits[state] - most - logf(sum);
    return state;
}

// What windows know of a frame: the states of the one before, the levels of changes (TORSIONS, residues, STATES, STATES),
// numbers `uniform` (residues, TORSIONS) to draw by, or none where the states `fresh` (residues, TORSIONS) are given.
struct Window {
    const int64_t *now;
    const float *levels, *uniform;
    int64_t *fresh;
    double log_probability;
};
struct Work {
    std::vector<float> x, y, logits, of_blocks;
    std::vector<int64_t> items;
};

// Goes through the torsions of windows, of which `h` (windows, residues, WIDTH) is all but what new states tell.
static void go_through(const Net &net, std::vector<Window> &windows, const float *h, Work &work) {
    const int64_t n = net.n_residues;
    work.x.resize(windows.size() * n * WIDTH), work.y.resize(windows.size() * n * WIDTH);
    work.logits.resize(windows.size() * n * STATES);
    for (int turn = 0; turn < 1 + net.coupled; ++turn)
        for (int torsion = 0; torsion < TORSIONS; ++torsion) {
            work.items.clear();
            for (size_t k = 0; k < windows.size(); ++k)
                for (int64_t r = turn; r < n; r += 1 + net.coupled) {
                    if (!net.counts[r * TORSIONS + torsion]) continue;
                    const int64_t *fresh = windows[k].fresh;
                    float *own = &work.x[work.items.size() * WIDTH];
                    work.items.push_back(k * n + r);
                    for (int i = 0; i < WIDTH; ++i)
                        own[i] = h[(k * n + r) * WIDTH + i] + net.torsion[torsion * WIDTH + i];
                    for (int j = 1; j < 3 && turn; ++j) add(own, net.beside[j - 1], net, fresh, r + PLACES[j]);
                    add(own, net.fresh[torsion], net, fresh, r, torsion);
                    for (int i = 0; i < WIDTH; ++i) own[i] = silu(own[i]);
                }
            const int64_t n_items = work.items.size();
            apply<WIDTH>(net.hidden, work.x.data(), work.y.data(), n_items, WIDTH);
            for (int64_t i = 0; i < n_items * WIDTH; ++i) work.y[i] = silu(work.y[i]);
            apply<WIDTH>(net.logits, work.y.data(), work.logits.data(), n_items, STATES);
            for (int64_t item = 0; item < n_items; ++item) {
                Window &window = windows[work.items[item] / n];
                const int64_t r = work.items[item] % n, place = r * TORSIONS + torsion, now = window.now[place];
                const float *level = window.levels + ((torsion * n + r) * STATES + now) * STATES;
                float *own = &work.logits[item * STATES];
                // To stay has the logit zero.
                for (int j = 0; j < STATES; ++j) own[j] = j == now ? 0 : own[j] + level[j];
                const float *uniform = window.uniform ? window.uniform + place : nullptr;
                window.fresh[place] =
                    taken(own, net.counts[place], uniform, window.fresh[place], &window.log_probability);
            }
        }
}

// Adds to h (residues, WIDTH) what the states of the frame before and of the one before that tell.
static void add_before(float *h, const Net &net, const int64_t *now, const int64_t *earlier) {
    for (int64_t r = 0; r < net.n_residues; ++r) {
        for (int j = 0; j < 3; ++j) add(h + r * WIDTH, net.before[j], net, now, r + PLACES[j]);
        add(h + r * WIDTH, net.earlier, net, earlier, r);
    }
}

// `common` (rows, frames, residues, WIDTH): what `of_times_alone` and `of_observed` add up to; `levels` (rows, frames,
// TORSIONS, residues, STATES, STATES), `given` (rows, residues, TORSIONS), `uniform` and `out` (rows, frames, residues,
// TORSIONS).
extern "C" void draw(
    const Net *net, int64_t rows, int64_t frames, const float *common, const float *levels, const int64_t *given,
    const float *uniform, int64_t *out
) {
    const int64_t n = net->n_residues, size = n * TORSIONS;
    std::vector<float> h(rows * n * WIDTH);
    std::vector<Window> windows(rows);
    Work work;
    memset(out, 0, sizeof(int64_t) * rows * frames * size);
    for (int64_t frame = 0; frame < frames; ++frame) {
        for (int64_t row = 0; row < rows; ++row) {
            const int64_t k = row * frames + frame;
            auto before = [&](int64_t by) { return frame < by ? given + row * size : out + (k - by) * size; };
            memcpy(&h[row * n * WIDTH], common + k * n * WIDTH, sizeof(float) * n * WIDTH);
            add_before(&h[row * n * WIDTH], *net, before(1), before(2));
            windows[row] = {before(1), levels + k * size * STATES * STATES, uniform + k * size, out + k * size, 0};
        }
        go_through(*net, windows, h.data(), work);
    }
}

// A molecule's states at endless times, in the mean over `n` frames before: their states `given` (n, residues, TORSIONS),
// of each all but what new states tell `h` (n, residues, WIDTH), and `levels` of changes; n = 0 where none are kept.
struct Endless {
    int64_t n;
    const int64_t *given;
    const float *h, *levels;
};

// Return the logarithm of how likely states are at endless times, but for a constant.
static double log_share(const Net &net, const Endless &endless, int64_t *states, Work &work) {
    std::vector<Window> windows(endless.n);
    for (int64_t k = 0; k < endless.n; ++k)
        windows[k] = {endless.given + k * net.n_residues * TORSIONS, endless.levels, nullptr, states, 0};
    go_through(net, windows, endless.h, work);
    double most = windows[0].log_probability, sum = 0;
    for (const Window &window : windows) most = fmax(most, window.log_probability);
    for (const Window &window : windows) sum += exp(window.log_probability - most);
    return most + log(sum);
}

// States of frames each of which follows from those of the one before alone, `time` (WIDTH) and `levels` (TORSIONS,
// residues, STATES, STATES) later, accepted by the rule of Metropolis and Hastings where `endless` is known. `uniform` (rows, frames, residues *
// TORSIONS + 1): the last number is for that.
extern "C" void draw_apart(
    const Net *net, const Endless *endless, int64_t rows, int64_t frames, const float *time, const float *levels,
    const int64_t *given, const float *uniform, int64_t *out
) {
    const int64_t n = net->n_residues, size = n * TORSIONS, wide = n * WIDTH;
    std::vector<float> h(rows * wide), after(rows * wide);
    std::vector<int64_t> now(given, given + rows * size), back(rows * size);
    std::vector<double> share(rows);
    std::vector<Window> there(rows), again(rows);
    Work work;

    auto known = [&](std::vector<float> &into, int64_t *states, int64_t stride) {
        for (int64_t row = 0; row < rows; ++row) {
            memcpy(&into[row * wide], net->types, sizeof(float) * wide);
            for (int64_t r = 0; r < n; ++r)
                for (int j = 0; j < 3; ++j)
                    add(&into[row * wide + r * WIDTH], net->given[j], *net, states + row * stride, r + PLACES[j]);
        }
        for (int b = 0; b < BLOCKS && net->coupled; ++b) pass(*net, net->blocks[b], into, work.of_blocks);
        for (int64_t row = 0; row < rows; ++row) {
            for (int64_t i = 0; i < wide; ++i) into[row * wide + i] += time[i % WIDTH];
            add_before(&into[row * wide], *net, states + row * stride, states + row * stride);
        }
    };

    known(h, now.data(), size);
    for (int64_t row = 0; row < rows && endless->n; ++row)
        share[row] = log_share(*net, *endless, &now[row * size], work);
    for (int64_t frame = 0; frame < frames; ++frame) {
        for (int64_t row = 0; row < rows; ++row) {
            int64_t *fresh = out + (row * frames + frame) * size;
            memset(fresh, 0, sizeof(int64_t) * size);
            there[row] = {&now[row * size], levels, uniform + (row * frames + frame) * (size + 1), fresh, 0};
        }
        go_through(*net, there, h.data(), work);
        known(after, out + frame * size, frames * size);
        if (!endless->n) {
            for (int64_t row = 0; row < rows; ++row) memcpy(&now[row * size], there[row].fresh, sizeof(int64_t) * size);
            h.swap(after);
            continue;
        }
        back = now;
        for (int64_t row = 0; row < rows; ++row) again[row] = {there[row].fresh, levels, nullptr, &back[row * size], 0};
        go_through(*net, again, after.data(), work);
        for (int64_t row = 0; row < rows; ++row) {
            int64_t *fresh = there[row].fresh, *own = &now[row * size];
            if (!memcmp(fresh, own, sizeof(int64_t) * size)) continue;
            const double likely = log_share(*net, *endless, fresh, work);
            const double ratio = likely - share[row] + again[row].log_probability - there[row].log_probability;
            if (there[row].uniform[size] < exp(fmin(0, ratio))) {
                memcpy(own, fresh, sizeof(int64_t) * size);
                memcpy(&h[row * wide], &after[row * wide], sizeof(float) * wide);
                share[row] = likely;
            } else
                memcpy(fresh, own, sizeof(int64_t) * size);
        }
    }
}
