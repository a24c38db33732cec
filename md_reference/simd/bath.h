// Langevin dynamics of W replicas with rigid bonds and rigid water, for any force.
//
// Integrator: Langevin middle (Zhang et al., J. Phys. Chem. A 123, 6056 (2019)), as OpenMM has it; without friction it is
// leapfrog. Arrays are [n_atoms][3] of V. A position is the sum of `x` and its rounding `low`: steps are shorter than what
// single precision resolves of a position.
#pragma once
#include "vectors.h"

struct Bath {
    int32_t n_atoms, n_bonds, n_waters;  // rigid waters are the last atoms, as oxygen and two hydrogens each
    const float *atoms;                  // [n_atoms][2]: 1/mass, thermal speed
    const int32_t *bonds;                // [n_bonds][2]: rigid
    const float *lengths;                // [n_bonds]
    float timestep, keep, noise;
    float water[3];                      // masses of oxygen and hydrogen; 1/mass of the molecule
    float legs[2];                       // rigid lengths O-H and H-H
    float inverse[9];                    // of the matrix of a water's velocity constraints (`slow_water`)
    float tolerance;                     // relative, of lengths
};

struct Replicas { V3 *x, *low, *v, *f, *move; Random *random; };  // `move` is room for the atoms that are not water

INLINE V3 apart(const Replicas *r, int i, int j) { return (r->x[j] - r->x[i]) + (r->low[j] - r->low[i]); }

// RATTLE (Andersen, J. Comput. Phys. 52, 24 (1983)), its velocities, for bonds. Returns 0 when they cannot be met.
static int slow_bonds(const Bath *b, const Replicas *r) {
    for (int round = 0; round < 200; round++) {
        V worst = splat(0.0f);
        for (int c = 0; c < b->n_bonds; c++) {
            const int i = b->bonds[2 * c], j = b->bonds[2 * c + 1];
            const float d2 = b->lengths[c] * b->lengths[c], mi = b->atoms[2 * i], mj = b->atoms[2 * j];
            const V3 d = r->x[j] - r->x[i];
            const V along = dot(r->v[j] - r->v[i], d), g = along * (-1.0f / ((mi + mj) * d2));
            worst = larger(worst, absolute(along) * (b->timestep / d2));
            r->v[i] = r->v[i] - (g * mi) * d;
            r->v[j] = r->v[j] + (g * mj) * d;
        }
        if (largest(worst) < 0.1f * b->tolerance) return 1;
    }
    return 0;
}

// The same of a rigid water: three linear equations, whose matrix is that of the rigid triangle.
INLINE void slow_water(const Bath *b, const V3 *x, V3 *v) {
    const float mo = 1.0f / b->water[0], mh = 1.0f / b->water[1], *m = b->inverse;
    const V3 p = x[1] - x[0], q = x[2] - x[0], s = x[2] - x[1];
    const V a = dot(p, v[1] - v[0]), c = dot(q, v[2] - v[0]), e = dot(s, v[2] - v[1]);
    const V g = m[0] * a + m[1] * c + m[2] * e, h = m[3] * a + m[4] * c + m[5] * e, k = m[6] * a + m[7] * c + m[8] * e;
    v[0] = v[0] + (g * mo) * p + (h * mo) * q;
    v[1] = v[1] - (g * mh) * p + (k * mh) * s;
    v[2] = v[2] - (h * mh) * q - (k * mh) * s;
}

// SHAKE (Ryckaert, Ciccotti and Berendsen, J. Comput. Phys. 23, 327 (1977)) of displacements `move` since x.
static int place_bonds(const Bath *b, const Replicas *r, V3 *move) {
    for (int round = 0; round < 200; round++) {
        V worst = splat(0.0f);
        for (int c = 0; c < b->n_bonds; c++) {
            const int i = b->bonds[2 * c], j = b->bonds[2 * c + 1];
            const float d2 = b->lengths[c] * b->lengths[c], mi = b->atoms[2 * i], mj = b->atoms[2 * j];
            const V3 before = apart(r, i, j), d = before + (move[j] - move[i]);
            const V off = d2 - dot(d, d), g = 0.5f * off / ((mi + mj) * dot(d, before));
            worst = larger(worst, absolute(off) * (1.0f / d2));
            move[i] = move[i] - (g * mi) * before;
            move[j] = move[j] + (g * mj) * before;
        }
        if (largest(worst) < b->tolerance) return 1;
    }
    return 0;
}

// SETTLE (Miyamoto and Kollman, J. Comput. Chem. 13, 952 (1992)), in its words, from the old oxygen as origin.
INLINE void place_water(const Bath *b, const Replicas *r, int o, V3 *move) {
    const float mo = b->water[0], mh = b->water[1], inverse_mass = b->water[2], oh = b->legs[0], hh = b->legs[1];
    const float rc = 0.5f * hh, height = sqrtf(oh * oh - rc * rc), ra = height * 2.0f * mh * inverse_mass, rb = height - ra;
    const V3 b0 = apart(r, o, o + 1), c0 = apart(r, o, o + 2);
    V3 a1 = move[0], b1 = b0 + move[1], c1 = c0 + move[2];
    const V3 com = splat(inverse_mass) * (splat(mo) * a1 + splat(mh) * (b1 + c1));
    a1 = a1 - com, b1 = b1 - com, c1 = c1 - com;
    V3 ez = cross(b0, c0), ex = cross(a1, ez), ey = cross(ez, ex);
    ez = (0.5f * two_over_root(dot(ez, ez))) * ez;
    ex = (0.5f * two_over_root(dot(ex, ex))) * ex;
    ey = (0.5f * two_over_root(dot(ey, ey))) * ey;
    const V xb0 = dot(ex, b0), yb0 = dot(ey, b0), xc0 = dot(ex, c0), yc0 = dot(ey, c0), za1 = dot(ez, a1);
    const V xb1 = dot(ex, b1), yb1 = dot(ey, b1), zb1 = dot(ez, b1);
    const V xc1 = dot(ex, c1), yc1 = dot(ey, c1), zc1 = dot(ez, c1);
    const V sin_phi = za1 * (1.0f / ra), cos_phi = root(1.0f - sin_phi * sin_phi);
    const V sin_psi = (zb1 - zc1) / (2.0f * rc * cos_phi);
    const V ya2 = ra * cos_phi, yb2 = -rb * cos_phi - rc * sin_psi * sin_phi, yc2 = -rb * cos_phi + rc * sin_psi * sin_phi;
    // Half of H-H along x', such that its length is exact.
    const V dy = yb2 - yc2, dz = zb1 - zc1;
    const V xb2 = -0.5f * root(hh * hh - dy * dy - dz * dz);
    const V alpha = xb2 * (xb0 - xc0) + yb0 * yb2 + yc0 * yc2, beta = xb2 * (yc0 - yb0) + xb0 * yb2 + xc0 * yc2;
    const V gamma = xb0 * yb1 - xb1 * yb0 + xc0 * yc1 - xc1 * yc0, size = alpha * alpha + beta * beta;
    const V s = (alpha * gamma - beta * root(size - gamma * gamma)) / size, c = root(1.0f - s * s);
    const V xa3 = -ya2 * s, ya3 = ya2 * c;
    const V xb3 = xb2 * c - yb2 * s, yb3 = xb2 * s + yb2 * c, xc3 = -xb2 * c - yc2 * s, yc3 = -xb2 * s + yc2 * c;
    move[0] = com + xa3 * ex + ya3 * ey + za1 * ez;
    move[1] = (com + xb3 * ex + yb3 * ey + zb1 * ez) - b0;
    move[2] = (com + xc3 * ex + yc3 * ey + zc1 * ez) - c0;
}

// Velocities without what lies along rigid bonds. Returns 0 when that cannot be met.
static int slow(const Bath *b, const Replicas *r) {
    for (int o = b->n_atoms - 3 * b->n_waters; o < b->n_atoms; o += 3) slow_water(b, r->x + o, r->v + o);
    return slow_bonds(b, r);
}

// The bath acts on one atom, which `move` says how far it goes.
INLINE void drift(const Bath *b, int atom, Random *random, V3 *v, V3 *move) {
    V now[3] = {b->keep * v->x, b->keep * v->y, b->keep * v->z};
    if (b->noise > 0.0f) {
        const float speed = b->noise * b->atoms[2 * atom + 1];
        V z[4];
        normals(random, z, z + 1);
        normals(random, z + 2, z + 3);
        for (int k = 0; k < 3; k++) now[k] += speed * z[k];
    }
    const V half = splat(0.5f * b->timestep);
    *move = half * (*v + V3{now[0], now[1], now[2]});
    *v = {now[0], now[1], now[2]};
}

INLINE void move_on(V *x, V *low, V move) {
    const V s = *low + move, sum = rounded(*x + s);
    *low = s - (sum - *x);
    *x = sum;
}

// Positions after a move, and velocities after what constraints changed of it: v is what moved the atoms.
INLINE void arrive(const Bath *b, const Replicas *r, int i, V3 move, V3 free) {
    r->v[i] = r->v[i] + splat(1.0f / b->timestep) * (move - free);
    move_on(&r->x[i].x, &r->low[i].x, move.x);
    move_on(&r->x[i].y, &r->low[i].y, move.y);
    move_on(&r->x[i].z, &r->low[i].z, move.z);
}

INLINE void kick(const Bath *b, const Replicas *r, int i) {
    r->v[i] = r->v[i] + splat(b->timestep * b->atoms[2 * i]) * r->f[i];
}

// One step with forces `r->f` at `r->x`. Returns 0 when rigid bonds cannot be met.
static int advance(const Bath *b, const Replicas *r) {
    const int n = b->n_atoms - 3 * b->n_waters;
    Random random = *r->random;
    for (int i = 0; i < n; i++) kick(b, r, i);
    if (!slow_bonds(b, r)) return 0;
    V3 *move = r->move, *free = r->f;
    for (int i = 0; i < n; i++) {
        drift(b, i, &random, r->v + i, move + i);
        free[i] = move[i];
    }
    if (!place_bonds(b, r, move)) return 0;
    for (int i = 0; i < n; i++) arrive(b, r, i, move[i], free[i]);
    for (int o = n; o < b->n_atoms; o += 3) {
        V3 move[3], free[3];
        for (int k = 0; k < 3; k++) kick(b, r, o + k);
        slow_water(b, r->x + o, r->v + o);
        for (int k = 0; k < 3; k++) {
            drift(b, o + k, &random, r->v + o + k, move + k);
            free[k] = move[k];
        }
        place_water(b, r, o, move);
        for (int k = 0; k < 3; k++) arrive(b, r, o + k, move[k], free[k]);
    }
    *r->random = random;
    return 1;
}
