// Terms of a molecule by a molecular mechanics force field: bonds, angles, torsions; all pairs, and GBSA-OBC.
//
// Energies are added to `energy` [W] where it is not null. Units of OpenMM: nm, kJ/mol.
#pragma once
#include "vectors.h"

struct Molecule {
    int32_t n_atoms, n_bonds, n_angles, n_torsions, n_biased, born;
    const int32_t *bonds;         // [n_bonds][2]
    const float *bond_terms;      // [n_bonds][2]: length, force constant
    const int32_t *angles;        // [n_angles][3]
    const float *angle_terms;     // [n_angles][2]: angle, force constant
    const int32_t *torsions;      // [n_torsions][4]
    const float *torsion_terms;   // [n_torsions][13]: constant, then of n = 1..6 the factors of cos and of sin
    const float *biases;          // [n_biased][2][W]: of the first torsions, each replica's own factors of cos and of sin
    const float *pairs;           // [n(n-1)/2][4], i < j: Coulomb, C12, C6, Born
    const float *radii;           // [n_atoms][4]: radius, radius - offset, scaled radius, Born self
    float surface;
    V *work;                      // [molecule_work(n_atoms)]
};

INLINE int64_t molecule_work(int64_t n) { return 4 * n + n * (n - 1); }

static void bonds(const Molecule *s, const V3 *x, V3 *f, double *energy) {
    for (int b = 0; b < s->n_bonds; b++) {
        const int i = s->bonds[2 * b], j = s->bonds[2 * b + 1];
        const float r0 = s->bond_terms[2 * b], k = s->bond_terms[2 * b + 1];
        const V3 d = x[j] - x[i];
        const V r = root(dot(d, d)), g = k * (r - r0) / r;
        f[i] = f[i] + g * d;
        f[j] = f[j] - g * d;
        if (energy) add_to(energy, 0.5f * k * (r - r0) * (r - r0));
    }
}

static void angles(const Molecule *s, const V3 *x, V3 *f, double *energy) {
    for (int a = 0; a < s->n_angles; a++) {
        const int i = s->angles[3 * a], j = s->angles[3 * a + 1], k = s->angles[3 * a + 2];
        const float t0 = s->angle_terms[2 * a], stiff = s->angle_terms[2 * a + 1];
        const V3 p = x[i] - x[j], q = x[k] - x[j];
        const V rp = 1.0f / root(dot(p, p)), rq = 1.0f / root(dot(q, q));
        const V c = smaller(larger(dot(p, q) * rp * rq, splat(-0.999999f)), splat(0.999999f)), off = arc_cosine(c) - t0;
        // dE/dtheta * dtheta/dcos, theta' = -1/sin.
        const V g = stiff * off / root(1.0f - c * c);
        const V3 fi = (g * rp) * (rq * q - (c * rp) * p), fk = (g * rq) * (rp * p - (c * rq) * q);
        f[i] = f[i] + fi;
        f[k] = f[k] + fk;
        f[j] = f[j] - (fi + fk);
        if (energy) add_to(energy, 0.5f * stiff * off * off);
    }
}

static void torsions(const Molecule *s, const V3 *x, V3 *f, double *energy) {
    for (int t = 0; t < s->n_torsions; t++) {
        const int32_t *q = s->torsions + 4 * t;
        const float *p = s->torsion_terms + 13 * t;
        const V3 a = x[q[1]] - x[q[0]], b = x[q[2]] - x[q[1]], c = x[q[3]] - x[q[2]], u = cross(a, b), w = cross(b, c);
        const V b2 = dot(b, b), bn = root(b2), u2 = 1.0f / dot(u, u), w2 = 1.0f / dot(w, w), uw = root(u2 * w2);
        const V co = dot(u, w) * uw, si = bn * dot(a, w) * uw;
        V cn = splat(1.0f), sn = splat(0.0f), slope = sn, sum = splat(p[0]);
        if (t < s->n_biased) {
            const V *own = (const V *)s->biases + 2 * t;
            slope = own[1] * co - own[0] * si;
            sum += own[0] * co + own[1] * si;
        }
        for (int n = 1; n <= 6; n++) {
            const V next = cn * co - sn * si;
            sn = sn * co + cn * si;
            cn = next;
            slope += (float)n * (p[2 * n] * cn - p[2 * n - 1] * sn);
            sum += p[2 * n - 1] * cn + p[2 * n] * sn;
        }
        // Blondel and Karplus, J. Comput. Chem. 17, 1132 (1996).
        const V3 gi = (slope * bn * u2) * u, gm = (-slope * bn * w2) * w;
        const V3 along = (dot(c, b) / b2) * gm - (dot(a, b) / b2) * gi;
        f[q[0]] = f[q[0]] + gi;
        f[q[3]] = f[q[3]] + gm;
        f[q[1]] = f[q[1]] + (along - gi);
        f[q[2]] = f[q[2]] - (along + gm);
        if (energy) add_to(energy, sum);
    }
}

// OBC (Onufriev, Bashford and Case, Proteins 55, 383 (2004), set II): one atom's share of another's Born sum, and the
// derivative of that share by the distance, over the distance.
INLINE void screen(V r, float own, float other, V *share, V *slope) {
    const V rinv = 1.0f / r, low = larger(splat(own), absolute(r - other));
    const V lo = 1.0f / low, up = 1.0f / (r + other), lo2 = lo * lo, up2 = up * up, ratio = log_ratio(up * low);
    const float o2 = other * other;
    const V inside = own < other - r ? 2.0f * (1.0f / own - lo) : splat(0.0f);
    const V term = lo - up + 0.25f * (r - o2 * rinv) * (up2 - lo2) + 0.5f * rinv * ratio + inside;
    const I seen = own < r + other;
    *share = seen ? term : splat(0.0f);
    *slope = seen ? (0.125f * (1.0f + o2 * rinv * rinv) * (lo2 - up2) + 0.25f * ratio * rinv * rinv) * rinv : splat(0.0f);
}

static void born_radii(const Molecule *s, const V3 *x, V *born, V *pull, V *chain, V *slopes, double *energy) {
    const int n = s->n_atoms;
    V *sum = pull;  // no longer needed where `pull` is written
    for (int i = 0; i < n; i++) sum[i] = splat(0.0f);
    for (int i = 0; i < n; i++)
        for (int j = i + 1; j < n; j++, slopes += 2) {
            const V3 d = x[j] - x[i];
            const V r = root(dot(d, d));
            V to_i, to_j;
            screen(r, s->radii[4 * i + 1], s->radii[4 * j + 2], &to_i, slopes);
            screen(r, s->radii[4 * j + 1], s->radii[4 * i + 2], &to_j, slopes + 1);
            sum[i] += to_i;
            sum[j] += to_j;
        }
    for (int i = 0; i < n; i++) {
        const float radius = s->radii[4 * i], offset = s->radii[4 * i + 1], self = s->radii[4 * i + 3];
        const float reach = radius + 0.14f;
        const V psi = 0.5f * offset * sum[i], t = hyperbolic(psi * (1.0f + psi * (-0.8f + psi * 4.85f)));
        const V b = 1.0f / (1.0f / offset - t / radius), ratio = radius / b, cube = ratio * ratio * ratio;
        const V area = s->surface * reach * reach * cube * cube;
        born[i] = b;
        chain[i] = b * b * (1.0f - t * t) * offset * (1.0f + psi * (-1.6f + psi * 14.55f)) / radius;
        // The self term is half of self / b.
        pull[i] = -0.5f * self / (b * b) - 6.0f * area / b;
        if (energy) add_to(energy, 0.5f * self / b + area);
    }
}

template <bool BORN>
static void pairs(const Molecule *s, const V3 *x, V3 *f, double *energy) {
    const int n = s->n_atoms;
    V *born = s->work, *pull = born + n, *chain = pull + n, *slopes = born + 4 * n;
    if (BORN) born_radii(s, x, born, pull, chain, slopes, energy);
    const float *q = s->pairs;
    for (int i = 0; i < n; i++)
        for (int j = i + 1; j < n; j++, q += 4) {
            const V3 d = x[j] - x[i];
            const V r2 = dot(d, d), inv2 = 1.0f / r2, inv = root(inv2), inv6 = inv2 * inv2 * inv2;
            const V coulomb = q[0] * inv, repel = q[1] * inv6 * inv6, attract = q[2] * inv6;
            // Minus the derivative of the energy, over r.
            V g = (coulomb + 12.0f * repel - 6.0f * attract) * inv2, e = coulomb + repel - attract;
            if (BORN) {
                const V bb = born[i] * born[j], t = 0.25f * r2 / bb, damp = exponential(-t);
                const V finv2 = 1.0f / (r2 + bb * damp), polar = q[3] * root(finv2);
                g += polar * (1.0f - 0.25f * damp) * finv2;
                const V by_bb = -0.5f * polar * damp * (1.0f + t) * finv2;
                pull[i] += by_bb * born[j];
                pull[j] += by_bb * born[i];
                e += polar;
            }
            f[i] = f[i] - g * d;
            f[j] = f[j] + g * d;
            if (energy) add_to(energy, e);
        }
    if (!BORN) return;
    for (int i = 0; i < n; i++) pull[i] *= chain[i];
    for (int i = 0; i < n; i++)
        for (int j = i + 1; j < n; j++, slopes += 2) {
            const V g = pull[i] * slopes[0] + pull[j] * slopes[1];
            const V3 d = x[j] - x[i];
            f[i] = f[i] - g * d;
            f[j] = f[j] + g * d;
        }
}

static void bonded(const Molecule *s, const V3 *x, V3 *f, double *energy) {
    bonds(s, x, f, energy);
    angles(s, x, f, energy);
    torsions(s, x, f, energy);
}
