// Energy and gradient of PAINET as a potential by SIMD: W copies of one molecule, one in each element of a vector
// register. What it computes, and in which order, is `energy.py`; the gradient is that of its every step, backwards.
//
// `langevin` moves the copies by it and by the bath of md_reference/simd, in double precision. A value is a V, or a D: one
// number for each copy. Arrays are [..][W]; weights are the same for all copies. Sizes of the network come as macros from
// simd.py, which compiles this at first use. No copy depends on the others, but for the number of rounds that rigid bonds
// take.
#include "bath.h"

#define N_SENT (N_SCALARS + N_VECTORS)
#define N_FOUND (N_SCALARS + N_VECTORS + N_TENSORS)
#define N_EDGE (N_STEPS * N_FOUND)
#define N_ATTENDED (N_HEADS * HEAD_DIM)

static const float HALF_WIDTH = 2.5f, SOFTENING_NM2 = 1e-8f, ROOT_TWO = 1.41421356f, LEAST_NORM = 1e-12f;

struct Linear { const float *weight, *turned, *bias; };  // [out][in], [in][out], [out]

struct Step {
    Linear send, first, second, third, qkv, out;
    const float *phi, *psi;  // [N_HEADS][n][n]
};

struct Network {
    int64_t n;
    Step steps[N_STEPS];
    Linear site;
    const float *members;  // [N_MEMBERS + 1][WIDTH + 1 + N_HEADS]: of the site, its bias, of the latent energy; their mean
    const float *of_atom;  // [n][WIDTH]
    const float *edges;    // [n][n][N_RADIAL][N_EDGE]: all looks
    const float *tables;   // [n][n][N_RADIAL][N_MEMBERS + 1]: each member's, of both directions, and their mean
    const float *pairs;    // [n][n][5]: log of the range's begin, 1/spacing, 1/cutoff^2, 1/nearest, 1/farthest
    float eta, wall;
};

// What a step keeps for its way back; `dh` and the like are gradients.
#define CARRIED(s) ((s) ? N_HEADS : 0)
#define ALL_VECTORS(s) (N_VECTORS + CARRIED(s))
#define N_TWO(n) ((n) * ((n) + 1) / 2)
#define N_INPUT(s) (WIDTH + N_SCALARS + N_TWO(ALL_VECTORS(s)) + N_TWO(N_TENSORS) + N_TENSORS * ALL_VECTORS(s))
#define MOST_INPUT N_INPUT(1)

struct Kept {
    V *input, *first, *second, *sent, *v, *t, *mid, *qkv, *norm, *total, *mean;
};

static inline V *take(V *&work, int64_t n) {
    V *found = work;
    work += n;
    return found;
}

INLINE V above_zero(V a) { return larger(a, splat(0.0f)); }

// Beyond e^80 a quotient by Newton's steps is no number: they take infinity times zero.
static float below(float exponent) { return exponent < 80.0f ? exponent : 80.0f; }

static void silu(const V *x, V *y, int64_t n) {
    const float *a = (const float *)x;
    float *b = (float *)y;
    _Pragma("omp simd") for (int64_t k = 0; k < n * W; k++) b[k] = a[k] / (1.0f + expf(below(-a[k])));
}

static void silu_back(const V *x, V *dy, int64_t n) {
    const float *a = (const float *)x;
    float *d = (float *)dy;
    _Pragma("omp simd") for (int64_t k = 0; k < n * W; k++) {
        const float g = 1.0f / (1.0f + expf(below(-a[k])));
        d[k] *= g * (1.0f + a[k] * (1.0f - g));
    }
}

template <int A, int O>
static inline void block(const float *w, const float *bias, int n_in, int in_stride, int n_out, const V *in, V *out) {
    V sum[A][O];
    for (int a = 0; a < A; a++)
        for (int o = 0; o < O; o++) sum[a][o] = splat(bias ? bias[o] : 0.0f);
    for (int i = 0; i < n_in; i++)
        for (int o = 0; o < O; o++)
            for (int a = 0; a < A; a++) sum[a][o] += w[o * n_in + i] * in[a * in_stride + i];
    for (int a = 0; a < A; a++)
        for (int o = 0; o < O; o++) out[a * n_out + o] = sum[a][o];
}

template <int A>
static inline void row_of_blocks(const float *w, const float *b, int n_in, int in_stride, int n_out, const V *in, V *out) {
#ifdef AVX512
    const int O = 6;  // 24 sums, as many as registers hold
#else
    const int O = 4;
#endif
    int o = 0;
    for (; o + O <= n_out; o += O) block<A, O>(w + o * n_in, b ? b + o : 0, n_in, in_stride, n_out, in, out + o);
    for (; o < n_out; o++) block<A, 1>(w + o * n_in, b ? b + o : 0, n_in, in_stride, n_out, in, out + o);
}

// Of each atom: out = weight in + bias.
static void linear(const float *w, const float *b, int n_in, int n_out, const V *in, V *out, int64_t n, int in_stride) {
    int64_t a = 0;
    for (; a + 4 <= n; a += 4) row_of_blocks<4>(w, b, n_in, in_stride, n_out, in + a * in_stride, out + a * n_out);
    for (; a < n; a++) row_of_blocks<1>(w, b, n_in, in_stride, n_out, in + a * in_stride, out + a * n_out);
}

static inline void products(const V x, const V y, const V z, V *p, int stride) {
    p[0] = x * x, p[stride] = y * y, p[2 * stride] = z * z;
    p[3 * stride] = ROOT_TWO * x * y, p[4 * stride] = ROOT_TWO * y * z, p[5 * stride] = ROOT_TWO * x * z;
}

static inline void products_back(const V x, const V y, const V z, const V *d, int stride, V *dx, V *dy, V *dz) {
    const V xx = d[0], yy = d[stride], zz = d[2 * stride], xy = d[3 * stride], yz = d[4 * stride], xz = d[5 * stride];
    *dx += 2.0f * x * xx + ROOT_TWO * (y * xy + z * xz);
    *dy += 2.0f * y * yy + ROOT_TWO * (x * xy + z * yz);
    *dz += 2.0f * z * zz + ROOT_TWO * (y * yz + x * xz);
}

// A pair i < j as all looks see it, from j to i; radial functions but those from `first` to `last` are zero in all copies.
struct Edge { V apart[3], distance, log, radial[N_RADIAL], shape[9]; int64_t first, last; };

static inline int64_t place(int64_t n, int64_t i, int64_t j) { return i < j ? i * n + j : j * n + i; }

// Where a pair is on its grid of radial functions.
static inline V on_grid(const Edge *e, const float *p) { return (e->log - p[0]) * p[1]; }
static inline V within_cutoff(const Edge *e, const float *p) { return above_zero(1.0f - p[2] * e->distance * e->distance); }

static void measure(const Network *net, const D *x, Edge *edges, V *energy) {
    const int64_t n = net->n;
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = i + 1; j < n; j++) {
            Edge *e = edges + i * n + j;
            const float *p = net->pairs + 5 * (i * n + j);
            V square = splat(SOFTENING_NM2);
            for (int a = 0; a < 3; a++) {
                e->apart[a] = __builtin_convertvector(x[3 * i + a] - x[3 * j + a], V);
                square += e->apart[a] * e->apart[a];
            }
            e->distance = root(square), e->log = log_ratio(e->distance);
            const V near = above_zero(1.0f - p[3] * e->distance), far = above_zero(p[4] * e->distance - 1.0f);
            *energy += 2.0f * net->wall * (near * near * near + far * far * far);
            const V inside = within_cutoff(e, p), cube = inside * inside * inside, at = on_grid(e, p);
            const float least = -largest<float>(-at) - HALF_WIDTH, most = largest<float>(at) + HALF_WIDTH;
            e->first = least > 0.0f ? (int64_t)least : 0;
            e->last = most < N_RADIAL - 1 ? (int64_t)(most + 1.0f) : N_RADIAL;
            if (!any(inside > 0.0f) || e->last < e->first) e->last = e->first;
            for (int64_t k = e->first; k < e->last; k++) {
                const V u = (at - (float)k) / HALF_WIDTH, bump = above_zero(1.0f - u * u);
                e->radial[k] = bump * bump * bump * cube;
            }
            for (int a = 0; a < 3; a++) e->shape[a] = e->apart[a] / e->distance;
            products(e->shape[0], e->shape[1], e->shape[2], e->shape + 3, 1);
        }
}

static void measure_back(const Network *net, const Edge *edges, const V *d_radial, const V *d_shape, Vu *grad) {
    const int64_t n = net->n;
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = i + 1; j < n; j++) {
            const Edge *e = edges + i * n + j;
            const float *p = net->pairs + 5 * (i * n + j);
            const V inside = within_cutoff(e, p), square = inside * inside, at = on_grid(e, p);
            V d_log = splat(0.0f), d_inside = splat(0.0f);
            for (int64_t k = e->first; k < e->last; k++) {
                const V u = (at - (float)k) / HALF_WIDTH, bump = above_zero(1.0f - u * u);
                const V d = d_radial[(i * n + j) * N_RADIAL + k] * 3.0f * bump * bump * square;
                d_log -= d * inside * u;
                d_inside += d * bump;
            }
            const V near = above_zero(1.0f - p[3] * e->distance), far = above_zero(p[4] * e->distance - 1.0f);
            V way[3];
            for (int a = 0; a < 3; a++) way[a] = d_shape[(i * n + j) * 9 + a];
            products_back(e->shape[0], e->shape[1], e->shape[2], d_shape + (i * n + j) * 9 + 3, 1, way, way + 1, way + 2);
            const V along = way[0] * e->shape[0] + way[1] * e->shape[1] + way[2] * e->shape[2];
            const V d_distance = (d_log * (2.0f * p[1] / HALF_WIDTH) - along) / e->distance
                - 2.0f * p[2] * e->distance * d_inside
                + 6.0f * net->wall * (p[4] * far * far - p[3] * near * near);
            for (int a = 0; a < 3; a++) {
                const V g = way[a] / e->distance + d_distance * e->shape[a];
                grad[3 * i + a] += g;
                grad[3 * j + a] -= g;
            }
        }
}

// Sums of a copy have one order, however many functions the copies beside it need: unrolled whole, the compiler has its own.
template <int C> static inline void channels(const float *w, const Edge *e, V *found) {
    V sum[C] = {};
    _Pragma("GCC unroll 1") for (int64_t k = e->first; k < e->last; k++)
        for (int c = 0; c < C; c++) sum[c] += w[k * N_EDGE + c] * e->radial[k];
    memcpy(found, sum, sizeof sum);
}

template <int K> static inline void functions(const float *w, const V *d_found, V *d_radial) {
    V sum[K];
    memcpy(sum, d_radial, sizeof sum);
    _Pragma("GCC unroll 1") for (int c = 0; c < N_FOUND; c++)
        for (int k = 0; k < K; k++) sum[k] += w[k * N_EDGE + c] * d_found[c];
    memcpy(d_radial, sum, sizeof sum);
}

// Channels of a look at an edge, before they are modulated by what the sender sends.
static inline void see(const float *w, const Edge *e, V *found) {
    int c = 0;
    for (; c + 14 <= N_FOUND; c += 14) channels<14>(w + c, e, found + c);
    for (; c + 7 <= N_FOUND; c += 7) channels<7>(w + c, e, found + c);
    for (; c < N_FOUND; c++) channels<1>(w + c, e, found + c);
}

// Their gradient -> that of radial functions.
static inline void see_back(const float *w, const Edge *e, const V *d_found, V *d_radial) {
    int64_t k = e->first;
    for (; k + 8 <= e->last; k += 8) functions<8>(w + k * N_EDGE, d_found, d_radial + k);
    w += k * N_EDGE, d_radial += k;
    switch (e->last - k) {
        case 7: return functions<7>(w, d_found, d_radial);
        case 6: return functions<6>(w, d_found, d_radial);
        case 5: return functions<5>(w, d_found, d_radial);
        case 4: return functions<4>(w, d_found, d_radial);
        case 3: return functions<3>(w, d_found, d_radial);
        case 2: return functions<2>(w, d_found, d_radial);
        case 1: return functions<1>(w, d_found, d_radial);
    }
}

template <int S>
static void look(const Network *net, const Edge *edges, const V *h, const V *carried, Kept *kept) {
    const int64_t n = net->n;
    const Step *step = net->steps + S;
    constexpr int NV = ALL_VECTORS(S), NI = N_INPUT(S);
    if (S) {
        linear(step->send.weight, step->send.bias, WIDTH, N_SENT, h, kept->sent, n, WIDTH);
        for (int64_t k = 0; k < n * N_SENT; k++) kept->sent[k] += 1.0f;
    }
    for (int64_t i = 0; i < n; i++) {
        V felt[N_SCALARS] = {}, v[3][NV] = {}, t[6][N_TENSORS] = {};
        for (int64_t j = 0; j < n; j++) {
            const Edge *e = edges + place(n, i, j);
            if (i == j || e->first == e->last) continue;
            V found[N_FOUND];
            see(net->edges + (i * n + j) * N_RADIAL * N_EDGE + S * N_FOUND, e, found);
            const float side = i < j ? 1.0f : -1.0f;
            if (S)
                for (int c = 0; c < N_SENT; c++) found[c] *= kept->sent[j * N_SENT + c];
            for (int c = 0; c < N_SCALARS; c++) felt[c] += found[c];
            for (int a = 0; a < 3; a++)
                for (int c = 0; c < N_VECTORS; c++) v[a][c] += side * e->shape[a] * found[N_SCALARS + c];
            for (int a = 0; a < 6; a++)
                for (int c = 0; c < N_TENSORS; c++) t[a][c] += e->shape[3 + a] * found[N_SENT + c];
        }
        for (int a = 0; S && a < 3; a++)
            for (int c = 0; c < N_HEADS; c++) v[a][N_VECTORS + c] = carried[(i * 3 + a) * N_HEADS + c];
        V squares[6][NV];
        for (int c = 0; c < NV; c++) products(v[0][c], v[1][c], v[2][c], squares[0] + c, NV);
        V *in = kept->input + i * NI;
        memcpy(in, h + i * WIDTH, sizeof(V) * WIDTH);
        in += WIDTH;
        memcpy(in, felt, sizeof felt);
        in += N_SCALARS;
        for (int a = 0; a < NV; a++)
            for (int b = a; b < NV; b++) *in++ = v[0][a] * v[0][b] + v[1][a] * v[1][b] + v[2][a] * v[2][b];
        for (int a = 0; a < N_TENSORS; a++) {
            for (int b = a; b < N_TENSORS + NV; b++) {
                V sum = splat(0.0f);
                for (int k = 0; k < 6; k++) sum += t[k][a] * (b < N_TENSORS ? t[k][b] : squares[k][b - N_TENSORS]);
                *in++ = sum;
            }
        }
        memcpy(kept->v + i * 3 * NV, v, sizeof v);
        memcpy(kept->t + i * 6 * N_TENSORS, t, sizeof t);
    }
}

// d_input -> gradients of carried vectors, of what each atom sends, of radial functions and shapes.
template <int S>
static void look_back(const Network *net, const Edge *edges, const Kept *kept, const V *d_input, V *d_carried, V *d_sent,
                      V *d_radial, V *d_shape) {
    const int64_t n = net->n;
    constexpr int NV = ALL_VECTORS(S), NI = N_INPUT(S);
    for (int64_t i = 0; i < n; i++) {
        const V *d = d_input + i * NI + WIDTH, *felt = d;
        const V(*v)[NV] = (const V(*)[NV])(kept->v + i * 3 * NV);
        const V(*t)[N_TENSORS] = (const V(*)[N_TENSORS])(kept->t + i * 6 * N_TENSORS);
        V dv[3][NV] = {}, dt[6][N_TENSORS] = {}, squares[6][NV], d_squares[6][NV] = {};
        for (int c = 0; c < NV; c++) products(v[0][c], v[1][c], v[2][c], squares[0] + c, NV);
        d += N_SCALARS;
        for (int a = 0; a < NV; a++)
            for (int b = a; b < NV; b++) {
                const V one = *d++;
                for (int k = 0; k < 3; k++) {
                    dv[k][a] += one * v[k][b];
                    dv[k][b] += one * v[k][a];
                }
            }
        for (int a = 0; a < N_TENSORS; a++)
            for (int b = a; b < N_TENSORS + NV; b++) {
                const V one = *d++;
                if (b < N_TENSORS)
                    for (int k = 0; k < 6; k++) {
                        dt[k][a] += one * t[k][b];
                        dt[k][b] += one * t[k][a];
                    }
                else
                    for (int k = 0; k < 6; k++) {
                        dt[k][a] += one * squares[k][b - N_TENSORS];
                        d_squares[k][b - N_TENSORS] += one * t[k][a];
                    }
            }
        for (int c = 0; c < NV; c++)
            products_back(v[0][c], v[1][c], v[2][c], d_squares[0] + c, NV, dv[0] + c, dv[1] + c, dv[2] + c);
        for (int a = 0; S && a < 3; a++)
            for (int c = 0; c < N_HEADS; c++) d_carried[(i * 3 + a) * N_HEADS + c] = dv[a][N_VECTORS + c];
        for (int64_t j = 0; j < n; j++) {
            const int64_t pair = place(n, i, j);
            const Edge *e = edges + pair;
            if (i == j || e->first == e->last) continue;
            const float *w = net->edges + (i * n + j) * N_RADIAL * N_EDGE + S * N_FOUND, side = i < j ? 1.0f : -1.0f;
            V found[N_FOUND], d_found[N_FOUND], shape[9] = {};
            see(w, e, found);
            for (int c = 0; c < N_SCALARS; c++) d_found[c] = felt[c];
            for (int c = 0; c < N_VECTORS; c++) {
                V sum = splat(0.0f);
                for (int a = 0; a < 3; a++) sum += e->shape[a] * dv[a][c];
                d_found[N_SCALARS + c] = side * sum;
            }
            for (int c = 0; c < N_TENSORS; c++) {
                V sum = splat(0.0f);
                for (int a = 0; a < 6; a++) sum += e->shape[3 + a] * dt[a][c];
                d_found[N_SENT + c] = sum;
            }
            if (S)
                for (int c = 0; c < N_SENT; c++) {
                    const V sent = kept->sent[j * N_SENT + c];
                    d_sent[j * N_SENT + c] += d_found[c] * found[c];
                    d_found[c] *= sent;
                    found[c] *= sent;
                }
            for (int a = 0; a < 3; a++)
                for (int c = 0; c < N_VECTORS; c++) shape[a] += dv[a][c] * found[N_SCALARS + c];
            for (int a = 0; a < 6; a++)
                for (int c = 0; c < N_TENSORS; c++) shape[3 + a] += dt[a][c] * found[N_SENT + c];
            see_back(w, e, d_found, d_radial + pair * N_RADIAL);
            for (int a = 0; a < 9; a++) d_shape[pair * 9 + a] += a < 3 ? side * shape[a] : shape[a];
        }
    }
}

static inline V dot(const V *a, const V *b) {
    V sum = splat(0.0f);
    for (int d = 0; d < HEAD_DIM; d++) sum += a[d] * b[d];
    return sum;
}

// Vectors of unit length, in place, and what they were long.
static void normalise(V *q, V *norm) {
    *norm = larger(root(dot(q, q)), splat(LEAST_NORM));
    for (int d = 0; d < HEAD_DIM; d++) q[d] /= *norm;
}

static void normalise_back(const V *q, const V norm, V *dq) {
    const V along = dot(q, dq);
    for (int d = 0; d < HEAD_DIM; d++) dq[d] = (dq[d] - along * q[d]) / norm;
}

// Values that attention averages: those of a head, then the position.
#define N_VALUES (HEAD_DIM + 3)

// `mid` -> `h` after the step and `carried` vectors.
static void attend(const Network *net, int s, const V *x, Kept *kept, V *h, V *carried, V *own) {
    const int64_t n = net->n;
    const Step *step = net->steps + s;
    linear(step->qkv.weight, step->qkv.bias, WIDTH, 3 * N_ATTENDED, kept->mid, kept->qkv, n, WIDTH);
    for (int64_t i = 0; i < n; i++)
        for (int k = 0; k < 2 * N_HEADS; k++)
            normalise(kept->qkv + i * 3 * N_ATTENDED + k * HEAD_DIM, kept->norm + i * 2 * N_HEADS + k);
    for (int64_t i = 0; i < n; i++)
        for (int a = 0; a < N_HEADS; a++) {
            const V *q = kept->qkv + i * 3 * N_ATTENDED + a * HEAD_DIM;
            const float *phi = step->phi + (a * n + i) * n, *psi = step->psi + (a * n + i) * n;
            V total = splat(0.0f), mean[N_VALUES] = {};
            for (int64_t j = 0; j < n; j++) {
                const V *k = kept->qkv + j * 3 * N_ATTENDED + N_ATTENDED + a * HEAD_DIM, *v = k + N_ATTENDED;
                const V weight = phi[j] + psi[j] * dot(q, k);
                total += weight;
                for (int d = 0; d < HEAD_DIM; d++) mean[d] += weight * v[d];
                for (int d = 0; d < 3; d++) mean[HEAD_DIM + d] += weight * x[3 * j + d];
            }
            kept->total[i * N_HEADS + a] = total;
            for (int d = 0; d < N_VALUES; d++) mean[d] /= total;
            memcpy(kept->mean + (i * N_HEADS + a) * N_VALUES, mean, sizeof mean);
            memcpy(own + (i * N_HEADS + a) * HEAD_DIM, mean, sizeof(V) * HEAD_DIM);
            for (int d = 0; d < 3; d++) carried[(i * 3 + d) * N_HEADS + a] = mean[HEAD_DIM + d] - x[3 * i + d];
        }
    linear(step->out.weight, step->out.bias, N_ATTENDED, WIDTH, own, h, n, N_ATTENDED);
    for (int64_t k = 0; k < n * WIDTH; k++) h[k] = (1.0f - net->eta) * kept->mid[k] + net->eta * h[k];
}

// `dh` after the step -> `dh` before it; `d_qkv` comes with what else is known of queries, `dx` is added to.
static void attend_back(const Network *net, int s, const V *x, const Kept *kept, V *dh, const V *d_carried, V *d_qkv, V *dx,
                        V *own, V *more) {
    const int64_t n = net->n;
    const Step *step = net->steps + s;
    linear(step->out.turned, 0, WIDTH, N_ATTENDED, dh, own, n, WIDTH);
    for (int64_t i = 0; i < n; i++)
        for (int a = 0; a < N_HEADS; a++) {
            const V *q = kept->qkv + i * 3 * N_ATTENDED + a * HEAD_DIM, *mean = kept->mean + (i * N_HEADS + a) * N_VALUES;
            const float *phi = step->phi + (a * n + i) * n, *psi = step->psi + (a * n + i) * n;
            const V per_total = 1.0f / kept->total[i * N_HEADS + a];
            V d[N_VALUES], along = splat(0.0f), *dq = d_qkv + i * 3 * N_ATTENDED + a * HEAD_DIM;
            for (int c = 0; c < HEAD_DIM; c++) d[c] = net->eta * own[(i * N_HEADS + a) * HEAD_DIM + c];
            for (int c = 0; c < 3; c++) {
                const V g = d_carried ? d_carried[(i * 3 + c) * N_HEADS + a] : splat(0.0f);
                d[HEAD_DIM + c] = g;
                dx[3 * i + c] -= g;
            }
            for (int c = 0; c < N_VALUES; c++) {
                d[c] *= per_total;
                along += d[c] * mean[c];
            }
            for (int64_t j = 0; j < n; j++) {
                const V *k = kept->qkv + j * 3 * N_ATTENDED + N_ATTENDED + a * HEAD_DIM, *v = k + N_ATTENDED;
                V *dk = d_qkv + j * 3 * N_ATTENDED + N_ATTENDED + a * HEAD_DIM, *dv = dk + N_ATTENDED;
                const V weight = phi[j] + psi[j] * dot(q, k);
                V d_weight = -along;
                for (int c = 0; c < HEAD_DIM; c++) {
                    d_weight += d[c] * v[c];
                    dv[c] += weight * d[c];
                }
                for (int c = 0; c < 3; c++) {
                    d_weight += d[HEAD_DIM + c] * x[3 * j + c];
                    dx[3 * j + c] += weight * d[HEAD_DIM + c];
                }
                d_weight *= psi[j];
                for (int c = 0; c < HEAD_DIM; c++) {
                    dq[c] += d_weight * k[c];
                    dk[c] += d_weight * q[c];
                }
            }
        }
    for (int64_t i = 0; i < n; i++)
        for (int k = 0; k < 2 * N_HEADS; k++) {
            const int64_t at = i * 3 * N_ATTENDED + k * HEAD_DIM;
            normalise_back(kept->qkv + at, kept->norm[i * 2 * N_HEADS + k], d_qkv + at);
        }
    linear(step->qkv.turned, 0, 3 * N_ATTENDED, WIDTH, d_qkv, more, n, 3 * N_ATTENDED);
    for (int64_t k = 0; k < n * WIDTH; k++) dh[k] = (1.0f - net->eta) * dh[k] + more[k];
}

// The last step's latent energy by head, a s - b s^2 over pairs with phi = a - 4 b and psi = 4 b.
static void latent(const Network *net, const V *qkv, V *d_qkv, V *energy) {
    const int64_t n = net->n;
    const Step *step = net->steps + N_STEPS - 1;
    for (int a = 0; a < N_HEADS; a++) {
        const float of_mean = net->members[N_MEMBERS * (WIDTH + 1 + N_HEADS) + WIDTH + 1 + a];
        energy[a] = splat(0.0f);
        for (int64_t i = 0; i < n; i++)
            for (int64_t j = 0; j < n; j++) {
                if (i == j) continue;
                const V *p = qkv + i * 3 * N_ATTENDED + a * HEAD_DIM, *q = qkv + j * 3 * N_ATTENDED + a * HEAD_DIM;
                V *dp = d_qkv + i * 3 * N_ATTENDED + a * HEAD_DIM, *dq = d_qkv + j * 3 * N_ATTENDED + a * HEAD_DIM;
                const float A = step->phi[(a * n + i) * n + j] + step->psi[(a * n + i) * n + j];
                const float B = 0.25f * step->psi[(a * n + i) * n + j];
                const V square = 2.0f - 2.0f * dot(p, q), d = -2.0f * of_mean * (A - 2.0f * B * square);
                energy[a] += square * (A - B * square);
                for (int c = 0; c < HEAD_DIM; c++) {
                    dp[c] += d * q[c];
                    dq[c] += d * p[c];
                }
            }
    }
}

template <int S>
static void forward(const Network *net, const Edge *edges, const V *x, Kept *kept, V *h, V *carried, V *scratch) {
    const int64_t n = net->n;
    const Step *step = net->steps + S;
    look<S>(net, edges, h, carried, kept + S);
    constexpr int NI = N_INPUT(S);
    linear(step->first.weight, step->first.bias, NI, WIDTH, kept[S].input, kept[S].first, n, NI);
    silu(kept[S].first, scratch, n * WIDTH);
    linear(step->second.weight, step->second.bias, WIDTH, WIDTH, scratch, kept[S].second, n, WIDTH);
    silu(kept[S].second, scratch, n * WIDTH);
    linear(step->third.weight, step->third.bias, WIDTH, WIDTH, scratch, kept[S].mid, n, WIDTH);
    for (int64_t k = 0; k < n * WIDTH; k++) kept[S].mid[k] += h[k];
    attend(net, S, x, kept + S, h, carried, scratch);
    if constexpr (S + 1 < N_STEPS) forward<S + 1>(net, edges, x, kept, h, carried, scratch);
}

struct Back { V *dh, *d_carried, *d_qkv, *dx, *d_input, *d_sent, *d_radial, *d_shape, *one, *other; };

template <int S>
static void backward(const Network *net, const Edge *edges, const V *x, Kept *kept, Back b) {
    const int64_t n = net->n;
    const Step *step = net->steps + S;
    attend_back(net, S, x, kept + S, b.dh, S + 1 < N_STEPS ? b.d_carried : 0, b.d_qkv, b.dx, b.one, b.other);
    memset((void *)b.d_qkv, 0, sizeof(V) * n * 3 * N_ATTENDED);
    linear(step->third.turned, 0, WIDTH, WIDTH, b.dh, b.one, n, WIDTH);
    silu_back(kept[S].second, b.one, n * WIDTH);
    linear(step->second.turned, 0, WIDTH, WIDTH, b.one, b.other, n, WIDTH);
    silu_back(kept[S].first, b.other, n * WIDTH);
    constexpr int NI = N_INPUT(S);
    linear(step->first.turned, 0, WIDTH, NI, b.other, b.d_input, n, WIDTH);
    memset((void *)b.d_sent, 0, sizeof(V) * n * N_SENT);
    look_back<S>(net, edges, kept + S, b.d_input, b.d_carried, b.d_sent, b.d_radial, b.d_shape);
    if constexpr (S > 0) {
        linear(step->send.turned, 0, N_SENT, WIDTH, b.d_sent, b.one, n, N_SENT);
        for (int64_t i = 0; i < n; i++)
            for (int c = 0; c < WIDTH; c++) b.dh[i * WIDTH + c] += b.one[i * WIDTH + c] + b.d_input[i * NI + c];
        backward<S - 1>(net, edges, x, kept, b);
    }
}

static int64_t laid_out(int64_t n, V *work, Kept *kept, Back *b, Edge **edges, V **x, V **h, V **carried, V **scratch) {
    V *const begin = work;
    *edges = (Edge *)take(work, n * n * (sizeof(Edge) / sizeof(V)));
    *x = take(work, 3 * n), *h = take(work, n * WIDTH), *carried = take(work, n * 3 * N_HEADS);
    const int64_t widest = WIDTH > N_ATTENDED ? WIDTH : N_ATTENDED;
    *scratch = take(work, n * widest);
    for (int s = 0; s < N_STEPS; s++)
        kept[s] = {take(work, n * MOST_INPUT), take(work, n * WIDTH), take(work, n * WIDTH), take(work, n * N_SENT),
                   take(work, n * 3 * ALL_VECTORS(1)), take(work, n * 6 * N_TENSORS), take(work, n * WIDTH),
                   take(work, n * 3 * N_ATTENDED), take(work, n * 2 * N_HEADS), take(work, n * N_HEADS),
                   take(work, n * N_HEADS * N_VALUES)};
    *b = {take(work, n * WIDTH), take(work, n * 3 * N_HEADS), take(work, n * 3 * N_ATTENDED), take(work, 3 * n),
          take(work, n * MOST_INPUT), take(work, n * N_SENT), take(work, n * n * N_RADIAL), take(work, n * n * 9),
          take(work, n * widest), take(work, n * widest)};
    return work - begin;
}

// What the bath gives velocities in a step, as it was drawn: [n][3][W].
struct Given {
    const Vu *drawn;
    __attribute__((always_inline)) Three<double> operator()(const Bath<double> *, int atom) const {
        const Vu *d = drawn + 3 * atom;
        return {__builtin_convertvector(d[0], D), __builtin_convertvector(d[1], D), __builtin_convertvector(d[2], D)};
    }
};

// Of an atom, what `langevin` needs beside: a gradient, in double precision forces and moves.
#define ROOM 15

extern "C" {

int64_t work_floats(int64_t n) {
    Kept kept[N_STEPS];
    Back b;
    Edge *edges;
    V *x, *h, *carried, *scratch;
    return W * (laid_out(n, 0, kept, &b, &edges, &x, &h, &carried, &scratch) + ROOM * n);
}

// `positions` [n][3][W] nm -> the members' `energy` [N_MEMBERS][W] and the `gradient` [n][3][W] of their mean,
// per nm, in the network's unit.
void evaluate(const Network *net, const double *positions, float *energy, float *gradient, float *work) {
    const int64_t n = net->n;
    const D *at = (const D *)positions;
    Kept kept[N_STEPS];
    Back b;
    Edge *edges;
    V *x, *h, *carried, *scratch, walls = splat(0.0f), of_heads[N_HEADS], total[N_MEMBERS];
    Vu *grad = (Vu *)gradient;
    laid_out(n, (V *)work, kept, &b, &edges, &x, &h, &carried, &scratch);
    for (int a = 0; a < 3; a++) {
        D mean = {};
        for (int64_t i = 0; i < n; i++) mean += at[3 * i + a];
        mean /= (double)n;
        for (int64_t i = 0; i < n; i++) x[3 * i + a] = __builtin_convertvector((at[3 * i + a] - mean) * 10.0, V);
    }
    measure(net, at, edges, &walls);
    for (int64_t k = 0; k < n * WIDTH; k++) h[k] = splat(net->of_atom[k]);
    forward<0>(net, edges, x, kept, h, carried, scratch);

    linear(net->site.weight, net->site.bias, WIDTH, WIDTH, h, b.one, n, WIDTH);
    silu(b.one, b.other, n * WIDTH);
    memset((void *)b.d_qkv, 0, sizeof(V) * n * 3 * N_ATTENDED);
    latent(net, kept[N_STEPS - 1].qkv, b.d_qkv, of_heads);
    for (int m = 0; m < N_MEMBERS; m++) {
        const float *w = net->members + m * (WIDTH + 1 + N_HEADS);
        V sum = walls + (float)n * w[WIDTH];
        for (int64_t i = 0; i < n; i++)
            for (int c = 0; c < WIDTH; c++) sum += w[c] * b.other[i * WIDTH + c];
        for (int a = 0; a < N_HEADS; a++) sum += w[WIDTH + 1 + a] * of_heads[a];
        total[m] = sum;
    }
    // The tables, whose mean's gradient begins those of radial functions.
    memset((void *)b.d_shape, 0, sizeof(V) * n * n * 9);
    for (int64_t i = 0; i < n; i++)
        for (int64_t pair = i * n + i + 1; pair < (i + 1) * n; pair++)
            for (int64_t k = edges[pair].first; k < edges[pair].last; k++) {
                const float *w = net->tables + (pair * N_RADIAL + k) * (N_MEMBERS + 1);
                for (int m = 0; m < N_MEMBERS; m++) total[m] += w[m] * edges[pair].radial[k];
                b.d_radial[pair * N_RADIAL + k] = splat(w[N_MEMBERS]);
            }

    for (int64_t i = 0; i < n; i++)
        for (int c = 0; c < WIDTH; c++)
            b.other[i * WIDTH + c] = splat(net->members[N_MEMBERS * (WIDTH + 1 + N_HEADS) + c]);
    silu_back(b.one, b.other, n * WIDTH);
    linear(net->site.turned, 0, WIDTH, WIDTH, b.other, b.dh, n, WIDTH);
    memset((void *)b.dx, 0, sizeof(V) * 3 * n);
    backward<N_STEPS - 1>(net, edges, x, kept, b);
    for (int64_t k = 0; k < 3 * n; k++) grad[k] = 10.0f * b.dx[k];
    measure_back(net, edges, b.d_radial, b.d_shape, grad);
    memcpy(energy, total, sizeof total);
}

// Positions nm and velocities nm/ps [n][3][W], in place, after steps in which the bath gives velocities what is `drawn`
// [n_steps][n][3][W]; `unit` of the network's energy, kJ/mol. The centre of mass is at rest.
void langevin(const Network *net, const Bath<double> *bath, double unit, double *positions, double *velocities,
              const float *drawn, int64_t n_steps, float *work) {
    const int64_t n = net->n;
    V *room = (V *)work + work_floats(n) / W - ROOM * n;
    float *gradient = (float *)take(room, 3 * n), energy[N_MEMBERS * W];
    D *force = (D *)take(room, 6 * n), *move = (D *)take(room, 6 * n);
    typedef Three<double> D3;
    const Replicas<double> r = {(D3 *)positions, 0, (D3 *)velocities, (D3 *)force, (D3 *)move};
    for (int64_t step = 0; step < n_steps; step++) {
        evaluate(net, positions, energy, gradient, work);
        for (int64_t k = 0; k < 3 * n; k++) force[k] = -unit * __builtin_convertvector(((const Vu *)gradient)[k], D);
        Given given = {(const Vu *)drawn + step * 3 * n};
        // Copies whose bonds cannot be met go on as far as they came.
        advance<true>(bath, &r, &given);
    }
}
}
