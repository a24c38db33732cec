// A solute in a periodic cell of rigid three-site water: Lennard-Jones and direct electrostatics within a cutoff.
//
// Electrostatics over r within the cutoff are q/r^3 less a polynomial in r^2: of Ewald's complementary part, or of a
// reaction field. Two molecules are in the image in which their middles are nearest (of a water: between its hydrogens),
// so that the cell must be wider than twice the cutoff and 0.152 nm. The same pairs of waters are computed in all
// replicas; waters trade places (`trade`) so that one place is in one region in all of them.
#pragma once
#include "vectors.h"

// Pieces of the polynomial are as many as a register has elements: they are looked up in one.
#define DEGREE (W == 16 ? 3 : W == 8 ? 4 : 6)
#define ENERGY_DEGREE 14
// Keeps GCC from undoing the order of the pair loops.
#if defined(__GNUC__) && !defined(__clang__)
#define TUNED __attribute__((optimize("no-tree-reassoc", "no-schedule-insns2", "no-tree-ter")))
#else
#define TUNED
#endif

struct Water {
    int32_t n_solute, n_waters, n_excluded, n_pairs;
    float cell[6], inverse[3];        // ax, bx, by, cx, cy, cz of a reduced cell; 1/ax, 1/by, 1/cz
    float cutoff2, list2;             // squares: of the cutoff; of the distance of middles up to which pairs are listed
    const V *force;                   // [DEGREE + 1]: eight times the polynomial in r^2 that is subtracted, minus
    float piece;                      // what r^2 is multiplied with, such that its nearest whole number is the piece
    float energy[ENERGY_DEGREE + 1];  // what 1/r lacks, in 2 r^2/cutoff^2 - 1
    float own[4];                     // of two waters, over eight: charges O-O, O-H, H-H; then C12, C6
    float lennard_jones[2];
    float inside[2];                  // excluded charges within a water, O-H and H-H
    const float *solute;              // [n_solute][4]: charges with O and with H over eight, C12, C6 with O
    const int32_t *pairs;             // [n_pairs][2] within the solute, not excluded
    const float *pair_terms;          // [n_pairs][3]: charges over eight, C12, C6
    const int32_t *excluded;          // [n_excluded][2]
    const float *excluded_terms;      // [n_excluded][4]: charges as they are in this exception, C12, C6; excluded charges
    int32_t n_units, ewald;
    V3 *middles;                      // [n_waters]
    int32_t *partners, *begins;       // pairs of waters: of i from begins[i] to begins[i + 1]
    const float *sites;               // [n_waters][3]: where the place of a water is meant to be
    const int32_t *near;              // [n_near][2]: places that may be swapped
    int32_t n_near;
    I *names;                         // [n_waters]: which water is here
    I *images;                        // [n_units][3]: cells by which each molecule was moved
};

INLINE V3 to_image(const Water *w, V3 d) {
    const float *c = w->cell, *inverse = w->inverse;
    const V k = nearest(d.z * inverse[2]);
    d.z -= k * c[5], d.y -= k * c[4], d.x -= k * c[3];
    const V j = nearest(d.y * inverse[1]);
    d.y -= j * c[2], d.x -= j * c[1];
    d.x -= nearest(d.x * inverse[0]) * c[0];
    return d;
}

INLINE V polynomial(const float *c, int degree, V u) {
    V p = splat(c[degree]);
    for (int k = degree - 1; k >= 0; k--) p = p * u + c[k];
    return p;
}

// What the energy of unit charges lacks of 1/r.
INLINE V lacking(const Water *w, V r2) { return polynomial(w->energy, ENERGY_DEGREE, r2 * (2.0f / w->cutoff2) - 1.0f); }

// What the force over distance lacks of 8/r^3.
INLINE V lacking_force(const Water *w, V r2) {
    const I piece = (I)(r2 * w->piece + 12582912.0f);
    V p = __builtin_shuffle(w->force[DEGREE], piece);
    for (int k = DEGREE - 1; k >= 0; k--) p = p * r2 + __builtin_shuffle(w->force[k], piece);
    return p;
}

// Force over distance of one pair of sites of charges (over eight) q; with ENERGY its energy is added to `energy`.
template <bool LJ, bool ENERGY>
INLINE V site(const Water *w, V r2, float q, float c12, float c6, double *energy) {
    const V z = two_over_root(r2);  // 2/r
    V g = q * (z * z * z + lacking_force(w, r2));
    V inverse2, inverse6;
    if (LJ) {
        inverse2 = 0.25f * z * z, inverse6 = inverse2 * inverse2 * inverse2;
        g += (12.0f * c12 * inverse6 - 6.0f * c6) * inverse6 * inverse2;
    }
    const I near = r2 < w->cutoff2;
    if (ENERGY) {
        V e = 8.0f * q * (0.5f * z + lacking(w, r2));
        if (LJ) e += (c12 * inverse6 - c6) * inverse6;
        add_to(energy, near ? e : splat(0.0f));
    }
    return near ? g : splat(0.0f);
}

// One site of a water with three of another, interleaved: each alone is a chain of operations that wait for each other.
// `charges` of the site with oxygen and with hydrogen.
template <bool LJ, bool ENERGY>
INLINE void three_sites(const Water *w, const V3 *a, V3 at, const float *charges, V3 *sum, V3 *back, double *energy) {
    V3 r[3], felt = {};
    V r2[3], z[3], g[3], u[3], p[3];
    I piece[3];
#pragma GCC unroll 3
    for (int k = 0; k < 3; k++) r[k] = at - a[k];
#pragma GCC unroll 3
    for (int k = 0; k < 3; k++) r2[k] = dot(r[k], r[k]);
#pragma GCC unroll 3
    for (int k = 0; k < 3; k++) z[k] = root_estimate(r2[k]);
#pragma GCC unroll 3
    for (int k = 0; k < 3; k++) u[k] = r2[k] * z[k];
#pragma GCC unroll 3
    for (int k = 0; k < 3; k++) u[k] = 3.0f - u[k] * z[k];
#pragma GCC unroll 3
    for (int k = 0; k < 3; k++) z[k] = z[k] * u[k];
#pragma GCC unroll 3
    for (int k = 0; k < 3; k++) piece[k] = (I)(r2[k] * w->piece + 12582912.0f);
#pragma GCC unroll 3
    for (int k = 0; k < 3; k++) p[k] = __builtin_shuffle(w->force[DEGREE], piece[k]);
#pragma GCC unroll 6
    for (int d = DEGREE - 1; d >= 0; d--)
#pragma GCC unroll 3
        for (int k = 0; k < 3; k++) p[k] = p[k] * r2[k] + __builtin_shuffle(w->force[d], piece[k]);
#pragma GCC unroll 3
    for (int k = 0; k < 3; k++) u[k] = z[k] * z[k];
#pragma GCC unroll 3
    for (int k = 0; k < 3; k++) g[k] = charges[k != 0] * (u[k] * z[k] + p[k]);
    if (LJ) {
        const V inverse2 = 0.25f * z[0] * z[0], inverse6 = inverse2 * inverse2 * inverse2;
        const float *lj = w->lennard_jones;
        g[0] += (12.0f * lj[0] * inverse6 - 6.0f * lj[1]) * inverse6 * inverse2;
        if (ENERGY) add_to(energy, r2[0] < w->cutoff2 ? (lj[0] * inverse6 - lj[1]) * inverse6 : splat(0.0f));
    }
#pragma GCC unroll 3
    for (int k = 0; k < 3; k++) {
        if (ENERGY) add_to(energy, r2[k] < w->cutoff2 ? 8.0f * charges[k != 0] * (0.5f * z[k] + lacking(w, r2[k])) : splat(0.0f));
        g[k] = r2[k] < w->cutoff2 ? g[k] : splat(0.0f);
        // Products once: additions have units of their own.
        const V3 h = {rounded(g[k] * r[k].x), rounded(g[k] * r[k].y), rounded(g[k] * r[k].z)};
        sum[k] = sum[k] - h;
        felt = felt + h;
    }
    *back = *back + felt;
}

template <bool ENERGY>
TUNED static void waters(const Water *w, const V3 *x, V3 *f, double *energy) {
    const V3 *first = x + w->n_solute;
    V3 *felt = f + w->n_solute;
    for (int i = 0; i < w->n_waters; i++) {
        const V3 *a = first + 3 * i;
        V3 sum[3] = {};
        for (int p = w->begins[i]; p < w->begins[i + 1]; p++) {
            const int j = w->partners[p];
            const V3 d = w->middles[i] - w->middles[j], shift = to_image(w, d) - d;
            const V3 *b = first + 3 * j;
            V3 *back = felt + 3 * j;
            three_sites<true, ENERGY>(w, a, b[0] - shift, w->own, sum, back, energy);
            three_sites<false, ENERGY>(w, a, b[1] - shift, w->own + 1, sum, back + 1, energy);
            three_sites<false, ENERGY>(w, a, b[2] - shift, w->own + 1, sum, back + 2, energy);
        }
        for (int k = 0; k < 3; k++) felt[3 * i + k] = felt[3 * i + k] + sum[k];
    }
}

template <bool ENERGY>
TUNED static void solute_and_water(const Water *w, const V3 *x, V3 *f, double *energy) {
    for (int j = 0; j < w->n_waters; j++) {
        const V3 *o = x + w->n_solute + 3 * j;
        V3 *back = f + w->n_solute + 3 * j;
        V3 sum[3] = {};
        for (int i = 0; i < w->n_solute; i++) {
            const float *t = w->solute + 4 * i;
            const V3 d = x[i] - w->middles[j], near = to_image(w, d);
            V3 felt = {};
#pragma GCC unroll 3
            for (int k = 0; k < 3; k++) {
                const V3 r = near + (w->middles[j] - o[k]);
                const V g = k == 0 ? site<true, ENERGY>(w, dot(r, r), t[0], t[2], t[3], energy)
                                   : site<false, ENERGY>(w, dot(r, r), t[1], 0.0f, 0.0f, energy);
                felt = felt + g * r;
                sum[k] = sum[k] - g * r;
            }
            f[i] = f[i] + felt;
        }
        for (int k = 0; k < 3; k++) back[k] = back[k] + sum[k];
    }
}

// What reciprocal space counts of charges that do not see each other: q erf(a r)/r, not within any cutoff.
INLINE V excluded_part(const Water *w, V r2, float q, double *energy) {
    // Of the polynomial, which ends at the cutoff, and beyond of nothing but 1/r: erf is 1 there to the Ewald tolerance.
    const V z = two_over_root(r2);
    const I near = r2 < w->cutoff2;
    if (energy) add_to(energy, q * (near ? lacking(w, r2) : -0.5f * z));
    return q * 0.125f * (near ? lacking_force(w, r2) : -z * z * z);
}

static void within(const Water *w, const V3 *x, V3 *f, double *energy) {
    for (int p = 0; p < w->n_pairs; p++) {
        const int i = w->pairs[2 * p], j = w->pairs[2 * p + 1];
        const float *t = w->pair_terms + 3 * p;
        const V3 r = to_image(w, x[i] - x[j]);
        const V g = energy ? site<true, true>(w, dot(r, r), t[0], t[1], t[2], energy)
                           : site<true, false>(w, dot(r, r), t[0], t[1], t[2], energy);
        f[i] = f[i] + g * r;
        f[j] = f[j] - g * r;
    }
    for (int p = 0; p < w->n_excluded; p++) {
        const int i = w->excluded[2 * p], j = w->excluded[2 * p + 1];
        const float *t = w->excluded_terms + 4 * p;
        const V3 r = x[i] - x[j];
        const V r2 = dot(r, r), z = 0.5f * two_over_root(r2), inverse2 = z * z, inverse6 = inverse2 * inverse2 * inverse2;
        V g = t[0] * z * inverse2 + (12.0f * t[1] * inverse6 - 6.0f * t[2]) * inverse6 * inverse2;
        if (energy) add_to(energy, t[0] * z + (t[1] * inverse6 - t[2]) * inverse6);
        if (w->ewald) g += excluded_part(w, r2, t[3], energy);
        f[i] = f[i] + g * r;
        f[j] = f[j] - g * r;
    }
    // Along rigid bonds no force matters: only where forces are compared.
    for (int j = 0; w->ewald && energy && j < w->n_waters; j++) {
        const V3 *o = x + w->n_solute + 3 * j;
        V3 *back = f + w->n_solute + 3 * j;
        for (int k = 0; k < 3; k++) {
            const int a = k == 2, b = k == 0 ? 1 : 2;
            const V3 r = o[a] - o[b];
            const V g = excluded_part(w, dot(r, r), w->inside[k == 2], energy);
            back[a] = back[a] + g * r;
            back[b] = back[b] - g * r;
        }
    }
}

static void find_middles(const Water *w, const V3 *x) {
    for (int i = 0; i < w->n_waters; i++) {
        const V3 *o = x + w->n_solute + 3 * i;
        w->middles[i] = splat(0.5f) * (o[1] + o[2]);
    }
}

static void direct(const Water *w, const V3 *x, V3 *f, double *energy) {
    find_middles(w, x);
    if (energy) {
        waters<true>(w, x, f, energy);
        solute_and_water<true>(w, x, f, energy);
    } else {
        waters<false>(w, x, f, energy);
        solute_and_water<false>(w, x, f, energy);
    }
    within(w, x, f, energy);
}

// Lists the pairs of waters whose middles are within reach in any replica. Returns how many.
static int64_t list_pairs(const Water *w, const V3 *x) {
    int32_t n = 0;
    find_middles(w, x);
    for (int i = 0; i < w->n_waters; i++) {
        w->begins[i] = n;
        for (int j = i + 1; j < w->n_waters; j++) {
            const V3 d = to_image(w, w->middles[i] - w->middles[j]);
            w->partners[n] = j;
            n += any(dot(d, d) < w->list2);
        }
    }
    w->begins[w->n_waters] = n;
    return n;
}

INLINE void swap_where(I mask, V *a, V *b) {
    const V p = *a, q = *b;
    *a = mask ? q : p;
    *b = mask ? p : q;
}

INLINE V off_site(const Water *w, V3 x, const float *site) {
    const V3 d = to_image(w, {x.x - site[0], x.y - site[1], x.z - site[2]});
    return dot(d, d);
}

// Lets two waters trade places, in each replica by itself, where both together are then nearer to where places are meant
// to be. Waters are alike, so nothing changes but their names; a place stays in its region while waters diffuse.
static void trade(const Water *w, V3 *x, V3 *low, V3 *v) {
    find_middles(w, x);
    const int first = w->n_units - w->n_waters;
    for (int p = 0; p < w->n_near; p++) {
        const int i = w->near[2 * p], j = w->near[2 * p + 1];
        const float *a = w->sites + 3 * i, *b = w->sites + 3 * j;
        const V3 mi = w->middles[i], mj = w->middles[j];
        const I mask = off_site(w, mi, a) + off_site(w, mj, b) > off_site(w, mi, b) + off_site(w, mj, a);
        if (!any(mask)) continue;
        V3 *of_both[] = {x, low, v};
        for (int k = 0; k < 3; k++) {
            V *one = (V *)(of_both[k] + w->n_solute + 3 * i), *other = (V *)(of_both[k] + w->n_solute + 3 * j);
            for (int c = 0; c < 9; c++) swap_where(mask, one + c, other + c);
        }
        V *one = (V *)(w->middles + i), *other = (V *)(w->middles + j);
        for (int c = 0; c < 3; c++) swap_where(mask, one + c, other + c);
        swap_where(mask, (V *)(w->names + i), (V *)(w->names + j));
        for (int c = 0; c < 3; c++)
            swap_where(mask, (V *)(w->images + 3 * (first + i) + c), (V *)(w->images + 3 * (first + j) + c));
    }
}
