// Reciprocal space of particle mesh Ewald (Essmann et al., J. Chem. Phys. 103, 8577 (1995)), splines of order 5.
//
// Charges are spread and potentials gathered in each replica's own grid, a row of five points at a time; the transforms
// run with all replicas side by side.
#pragma once
#include "vectors.h"

#define ORDER 5
#define PAD 8          // a row is read and written eight points wide
#define MOST_POINTS 128
#define MOST_FACTORS 8

struct Transform { int n, n_factors, factors[MOST_FACTORS]; float turns[2 * MOST_POINTS]; };  // cos, sin of -2 pi k / n

struct Mesh {
    int32_t n_atoms, nx, ny, nz;
    const int32_t *order;      // [n_atoms]: neighbours in memory apart, or they would wait for each other's rows
    const float *charges;      // [n_atoms], times the root of Coulomb's constant, over 24^3
    const float *influence;    // [nx][ny][nz / 2 + 1]: of a mode's square on the energy, twice what is counted once
    float to_cell[9];          // fraction of cell vector k: sum over d of to_cell[3 d + k] x_d
    Transform along[3];
    float *own;                // [W][nx][ny][nz + PAD]
    V *modes;                  // [nx][ny][nz / 2 + 1][2]
    float *fractions, *felt;   // [W][3][padded atoms]
    int32_t *cells;            // [W][3][padded atoms]
};

INLINE int padded(int n) { return (n + W - 1) / W * W; }

struct C { V re, im; };
INLINE C operator+(C a, C b) { return {a.re + b.re, a.im + b.im}; }
INLINE C operator-(C a, C b) { return {a.re - b.re, a.im - b.im}; }
INLINE C turned(C a, float c, float s) { return {c * a.re - s * a.im, c * a.im + s * a.re}; }

template <int R>
INLINE void butterfly(C *a, float sign) {
    if constexpr (R == 2) {
        const C b = a[0] - a[1];
        a[0] = a[0] + a[1];
        a[1] = b;
    } else if constexpr (R == 4) {
        const C p = a[0] + a[2], q = a[0] - a[2], r = a[1] + a[3], d = a[1] - a[3];
        const C s = {-sign * d.im, sign * d.re};
        a[0] = p + r, a[1] = q + s, a[2] = p - r, a[3] = q - s;
    } else {
        static const float c3[] = {-0.5f}, s3[] = {0.8660254038f};
        static const float c5[] = {0.3090169944f, -0.8090169944f}, s5[] = {0.9510565163f, 0.5877852523f};
        static const float c7[] = {0.6234898019f, -0.2225209340f, -0.9009688679f};
        static const float s7[] = {0.7818314825f, 0.9749279122f, 0.4338837391f};
        const float *c = R == 3 ? c3 : R == 5 ? c5 : c7, *s = R == 3 ? s3 : R == 5 ? s5 : s7;
        constexpr int H = (R - 1) / 2;
        C even[H], odd[H], out[R];
        out[0] = a[0];
        for (int k = 0; k < H; k++) even[k] = a[k + 1] + a[R - 1 - k], odd[k] = a[k + 1] - a[R - 1 - k], out[0] = out[0] + even[k];
        for (int m = 1; m <= H; m++) {
            C p = a[0], q = {splat(0.0f), splat(0.0f)};
            for (int k = 1; k <= H; k++) {
                const int at = m * k % R;
                const float cc = c[(at <= H ? at : R - at) - 1], ss = sign * (at <= H ? s[at - 1] : -s[R - at - 1]);
                p.re += cc * even[k - 1].re, p.im += cc * even[k - 1].im;
                q.re -= ss * odd[k - 1].im, q.im += ss * odd[k - 1].re;
            }
            out[m] = p + q, out[R - m] = p - q;
        }
        for (int k = 0; k < R; k++) a[k] = out[k];
    }
}

// One pass of Stockham's algorithm: n = (what is done) * R * (rest).
template <int R>
static void pass(const Transform *t, int done, const C *in, C *out, float sign) {
    const int rest = t->n / (done * R);
    for (int k = 0; k < done; k++)
        for (int m = 0; m < rest; m++) {
            C a[R];
            for (int r = 0; r < R; r++) {
                a[r] = in[(r * rest + m) * done + k];
                if (r && k) {
                    const float *w = t->turns + 2 * (r * k * rest);
                    a[r] = turned(a[r], w[0], -sign * w[1]);
                }
            }
            butterfly<R>(a, sign);
            for (int r = 0; r < R; r++) out[(m * R + r) * done + k] = a[r];
        }
}

// In place, of n points; `sign` -1 forwards and +1 backwards, without a factor.
static void transform(const Transform *t, C *line, float sign) {
    C room[MOST_POINTS], *in = line, *out = room;
    for (int f = 0, done = 1; f < t->n_factors; done *= t->factors[f++]) {
        switch (t->factors[f]) {
            case 2: pass<2>(t, done, in, out, sign); break;
            case 3: pass<3>(t, done, in, out, sign); break;
            case 4: pass<4>(t, done, in, out, sign); break;
            case 5: pass<5>(t, done, in, out, sign); break;
            default: pass<7>(t, done, in, out, sign);
        }
        C *other = in;
        in = out, out = other;
    }
    if (in != line) memcpy((void *)line, in, sizeof(C) * t->n);
}

// Along one axis of the modes, from and to every `stride`-th.
static void transform_strided(const Transform *t, C *modes, int64_t stride, float sign) {
    C line[MOST_POINTS];
    for (int k = 0; k < t->n; k++) line[k] = modes[k * stride];
    transform(t, line, sign);
    for (int k = 0; k < t->n; k++) modes[k * stride] = line[k];
}

// Weights of five points, times 24, and their derivatives by the fraction of a cell: coefficients of t^0 to t^4.
static const V8 SPLINE[5] = {{1, 11, 11, 1, 0}, {-4, -12, 12, 4, 0}, {6, -6, -6, 6, 0}, {-4, 12, -12, 4, 0}, {1, -4, 6, -4, 1}};

INLINE V8 weights(float t) { return (((SPLINE[4] * t + SPLINE[3]) * t + SPLINE[2]) * t + SPLINE[1]) * t + SPLINE[0]; }
INLINE V8 slopes(float t) { return ((4.0f * SPLINE[4] * t + 3.0f * SPLINE[3]) * t + 2.0f * SPLINE[2]) * t + SPLINE[1]; }

static void locate(const Mesh *m, const V3 *x) {
    const int many = padded(m->n_atoms), sizes[3] = {m->nx, m->ny, m->nz};
    for (int first = 0; first < many; first += W)
        for (int k = 0; k < 3; k++) {
            V cells[W], fractions[W];
            for (int l = 0; l < W; l++) {
                const int i = first + l < m->n_atoms ? first + l : m->n_atoms - 1;
                const float size = sizes[k], *to = m->to_cell;
                V u = to[k] * x[i].x + to[3 + k] * x[i].y + to[6 + k] * x[i].z;
                u = u - nearest(u);
                u = size * (u < 0.0f ? u + 1.0f : u);
                V floor = nearest(u);
                floor = floor > u ? floor - 1.0f : floor;
                fractions[l] = u - floor;
                cells[l] = (V)__builtin_convertvector(floor >= size ? floor - size : floor, I);
            }
            transpose(cells);
            transpose(fractions);
            for (int l = 0; l < W; l++) {
                memcpy(m->cells + (l * 3 + k) * many + first, cells + l, sizeof(V));
                memcpy(m->fractions + (l * 3 + k) * many + first, fractions + l, sizeof(V));
            }
        }
}

static void spread(const Mesh *m) {
    const int many = padded(m->n_atoms), row = m->nz + PAD;
    for (int l = 0; l < W; l++) {
        float *grid = m->own + (int64_t)l * m->nx * m->ny * row;
        memset(grid, 0, sizeof(float) * m->nx * m->ny * row);
        const float *t = m->fractions + 3 * l * many;
        const int32_t *at = m->cells + 3 * l * many;
        for (int k = 0; k < m->n_atoms; k++) {
            const int a = m->order[k];
            const V8 wx = m->charges[a] * weights(t[a]), wy = weights(t[many + a]), wz = weights(t[2 * many + a]);
            const int ix = at[a], iy = at[many + a], iz = at[2 * many + a];
            int rows[ORDER];
            for (int j = 0; j < ORDER; j++) rows[j] = (iy + j < m->ny ? iy + j : iy + j - m->ny) * row + iz;
            for (int i = 0; i < ORDER; i++) {
                float *plane = grid + (ix + i < m->nx ? ix + i : ix + i - m->nx) * m->ny * row;
                const V8 w = wx[i] * wz;
                for (int j = 0; j < ORDER; j++) *(V8u *)(plane + rows[j]) += wy[j] * w;
            }
        }
        for (int r = 0; r < m->nx * m->ny; r++)
            for (int k = 0; k < ORDER - 1; k++) grid[r * row + k] += grid[r * row + m->nz + k];
    }
}

// Own rows (two at a time, as real and imaginary part) to modes along z.
static void rows_to_modes(const Mesh *m) {
    const int n = m->nz, half = n / 2 + 1, row = n + PAD, many = m->nx * m->ny;
    for (int r = 0; r < many; r += 2) {
        C line[MOST_POINTS + W];
        for (int part = 0; part < 2; part++)
            for (int first = 0; first < n; first += W) {
                V block[W];
                const int of = r + part < many ? r + part : r;
                for (int l = 0; l < W; l++) memcpy(block + l, m->own + ((int64_t)l * many + of) * row + first, sizeof(V));
                transpose(block);
                for (int k = 0; k < W; k++) (part ? line[first + k].im : line[first + k].re) = block[k];
            }
        transform(m->along + 2, line, -1.0f);
        C *one = (C *)m->modes + (int64_t)r * half, *other = one + half;
        for (int k = 0; k < half; k++) {
            const C a = line[k], b = line[k ? n - k : 0];
            one[k] = {0.5f * (a.re + b.re), 0.5f * (a.im - b.im)};
            if (r + 1 < many) other[k] = {0.5f * (a.im + b.im), 0.5f * (b.re - a.re)};
        }
    }
}

static void modes_to_rows(const Mesh *m) {
    const int n = m->nz, half = n / 2 + 1, row = n + PAD, many = m->nx * m->ny;
    for (int r = 0; r < many; r += 2) {
        C line[MOST_POINTS + W] = {};
        const C *one = (C *)m->modes + (int64_t)r * half, *other = r + 1 < many ? one + half : one;
        for (int k = 0; k < half; k++) {
            const C a = one[k], b = other[k];
            line[k] = {a.re - b.im, a.im + b.re};
            if (k) line[n - k] = {a.re + b.im, b.re - a.im};
        }
        // The mode that is its own mirror image is real.
        transform(m->along + 2, line, 1.0f);
        for (int part = 0; part < 2 && r + part < many; part++)
            for (int first = 0; first < n; first += W) {
                V block[W];
                for (int k = 0; k < W; k++) block[k] = part ? line[first + k].im : line[first + k].re;
                transpose(block);
                for (int l = 0; l < W; l++) {
                    float *to = m->own + ((int64_t)l * many + r + part) * row + first;
                    memcpy(to, block + l, sizeof(float) * (first + W <= n + PAD ? W : n + PAD - first));
                }
            }
    }
    for (int64_t r = 0; r < (int64_t)W * many; r++) memcpy(m->own + r * row + n, m->own + r * row, sizeof(float) * PAD);
}

// Charges in the grids become potentials; to `energy` [W] their energy is added where it is not null.
static void convolve(const Mesh *m, double *energy) {
    const int half = m->nz / 2 + 1;
    rows_to_modes(m);
    C *modes = (C *)m->modes;
    for (int i = 0; i < m->nx; i++)
        for (int k = 0; k < half; k++) transform_strided(m->along + 1, modes + ((int64_t)i * m->ny * half + k), half, -1.0f);
    const int64_t plane = (int64_t)m->ny * half;
    for (int64_t p = 0; p < plane; p++) {
        C line[MOST_POINTS];
        for (int k = 0; k < m->nx; k++) line[k] = modes[k * plane + p];
        transform(m->along, line, -1.0f);
        for (int k = 0; k < m->nx; k++) {
            const float g = m->influence[k * plane + p];
            if (energy) {
                const bool alone = p % half == 0 || (m->nz % 2 == 0 && p % half == half - 1);
                add_to(energy, (alone ? 0.5f : 1.0f) * g * (line[k].re * line[k].re + line[k].im * line[k].im));
            }
            line[k] = {g * line[k].re, g * line[k].im};
        }
        transform(m->along, line, 1.0f);
        for (int k = 0; k < m->nx; k++) modes[k * plane + p] = line[k];
    }
    for (int i = 0; i < m->nx; i++)
        for (int k = 0; k < half; k++) transform_strided(m->along + 1, modes + ((int64_t)i * m->ny * half + k), half, 1.0f);
    modes_to_rows(m);
}

static void gather(const Mesh *m, V3 *f) {
    const int many = padded(m->n_atoms), row = m->nz + PAD;
    for (int l = 0; l < W; l++) {
        const float *grid = m->own + (int64_t)l * m->nx * m->ny * row, *t = m->fractions + 3 * l * many;
        const int32_t *at = m->cells + 3 * l * many;
        float *felt = m->felt + 3 * l * many;
        for (int a = 0; a < m->n_atoms; a++) {
            const float tx = t[a], ty = t[many + a], tz = t[2 * many + a], q = -m->charges[a];
            const V8 wx = weights(tx), dx = slopes(tx), wy = weights(ty), dy = slopes(ty), wz = weights(tz), dz = slopes(tz);
            const int ix = at[a], iy = at[many + a], iz = at[2 * many + a];
            int rows[ORDER];
            for (int j = 0; j < ORDER; j++) rows[j] = (iy + j < m->ny ? iy + j : iy + j - m->ny) * row + iz;
            V8 plain = {}, by_x = {}, by_y = {};
            for (int i = 0; i < ORDER; i++) {
                const float *above = grid + (ix + i < m->nx ? ix + i : ix + i - m->nx) * m->ny * row;
                V8 p = {}, d = {};
                for (int j = 0; j < ORDER; j++) {
                    const V8 r = *(const V8u *)(above + rows[j]);
                    p += wy[j] * r;
                    d += dy[j] * r;
                }
                plain += wx[i] * p, by_x += dx[i] * p, by_y += wx[i] * d;
            }
            by_x *= wz, by_y *= wz, plain *= dz;
            felt[a] = q * m->nx * (by_x[0] + by_x[1] + by_x[2] + by_x[3] + by_x[4]);
            felt[many + a] = q * m->ny * (by_y[0] + by_y[1] + by_y[2] + by_y[3] + by_y[4]);
            felt[2 * many + a] = q * m->nz * (plain[0] + plain[1] + plain[2] + plain[3] + plain[4]);
        }
    }
    for (int first = 0; first < many; first += W) {
        V g[3][W];
        for (int k = 0; k < 3; k++) {
            for (int l = 0; l < W; l++) memcpy(g[k] + l, m->felt + (3 * l + k) * many + first, sizeof(V));
            transpose(g[k]);
        }
        const float *to = m->to_cell;
        for (int k = 0; k < W && first + k < m->n_atoms; k++) {
            V3 *here = f + first + k;
            here->x += to[0] * g[0][k] + to[1] * g[1][k] + to[2] * g[2][k];
            here->y += to[3] * g[0][k] + to[4] * g[1][k] + to[5] * g[2][k];
            here->z += to[6] * g[0][k] + to[7] * g[1][k] + to[8] * g[2][k];
        }
    }
}

// Adds the forces of reciprocal space, and to `energy` [W] its energy where it is not null.
static void reciprocal(const Mesh *m, const V3 *x, V3 *f, double *energy) {
    locate(m, x);
    spread(m);
    convolve(m, energy);
    gather(m, f);
}
