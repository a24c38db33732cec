// Langevin dynamics of W replicas with rigid bonds and rigid water, for any force, in single or double precision S.
//
// Integrator: Langevin middle (Zhang et al., J. Phys. Chem. A 123, 6056 (2019)), as OpenMM has it; without friction it is
// leapfrog. Arrays are [n_atoms][3][W]. In single precision a position is the sum of `x` and its rounding `low`: steps are
// shorter than what that precision resolves of a position.
#pragma once
#include "vectors.h"

template <class S> struct Bath {
    int32_t n_atoms, n_bonds;  // without rigid waters
    const S *atoms;            // [n_atoms, with waters][2]: 1/mass, thermal speed
    const int32_t *bonds;      // [n_bonds][2]: rigid
    const S *lengths;          // [n_bonds]
    S timestep, keep, noise;
    S tolerance;               // relative, of lengths
};

// The last atoms, as oxygen and two hydrogens each.
struct RigidWaters {
    int32_t n;
    float masses[3];   // of oxygen and hydrogen; 1/mass of the molecule
    float legs[2];     // rigid lengths O-H and H-H
    float inverse[9];  // of the matrix of a water's velocity constraints (`slow_water`)
};

template <class S> struct Replicas { Three<S> *x, *low, *v, *f, *move; };  // `move` is room for the atoms of the bath

template <class S> INLINE Three<S> apart(const Replicas<S> *r, int i, int j) {
    const Three<S> d = r->x[j] - r->x[i];
    if constexpr (sizeof(S) == 8) return d;
    else return d + (r->low[j] - r->low[i]);
}

// RATTLE (Andersen, J. Comput. Phys. 52, 24 (1983)), its velocities, for bonds. Returns 0 when they cannot be met.
template <class S>
static int slow_bonds(const Bath<S> *b, const Replicas<S> *r) {
    for (int round = 0; round < 200; round++) {
        Each<S> worst = {};
        for (int c = 0; c < b->n_bonds; c++) {
            const int i = b->bonds[2 * c], j = b->bonds[2 * c + 1];
            const S d2 = b->lengths[c] * b->lengths[c], mi = b->atoms[2 * i], mj = b->atoms[2 * j];
            const Three<S> d = r->x[j] - r->x[i];
            const Each<S> along = dot(r->v[j] - r->v[i], d), g = along * (-1.0f / ((mi + mj) * d2));
            worst = larger(worst, absolute(along) * (b->timestep / d2));
            r->v[i] = r->v[i] - (g * mi) * d;
            r->v[j] = r->v[j] + (g * mj) * d;
        }
        if (largest<S>(worst) < 0.1f * b->tolerance) return 1;
    }
    return 0;
}

// The same of a rigid water: three linear equations, whose matrix is that of the rigid triangle.
INLINE void slow_water(const RigidWaters *b, const V3 *x, V3 *v) {
    const float mo = 1.0f / b->masses[0], mh = 1.0f / b->masses[1], *m = b->inverse;
    const V3 p = x[1] - x[0], q = x[2] - x[0], s = x[2] - x[1];
    const V a = dot(p, v[1] - v[0]), c = dot(q, v[2] - v[0]), e = dot(s, v[2] - v[1]);
    const V g = m[0] * a + m[1] * c + m[2] * e, h = m[3] * a + m[4] * c + m[5] * e, k = m[6] * a + m[7] * c + m[8] * e;
    v[0] = v[0] + (g * mo) * p + (h * mo) * q;
    v[1] = v[1] - (g * mh) * p + (k * mh) * s;
    v[2] = v[2] - (h * mh) * q - (k * mh) * s;
}

// SHAKE (Ryckaert, Ciccotti and Berendsen, J. Comput. Phys. 23, 327 (1977)) of displacements `move` since x.
template <class S>
static int place_bonds(const Bath<S> *b, const Replicas<S> *r) {
    Three<S> *move = r->move;
    for (int round = 0; round < 200; round++) {
        Each<S> worst = {};
        for (int c = 0; c < b->n_bonds; c++) {
            const int i = b->bonds[2 * c], j = b->bonds[2 * c + 1];
            const S d2 = b->lengths[c] * b->lengths[c], mi = b->atoms[2 * i], mj = b->atoms[2 * j];
            const Three<S> before = apart(r, i, j), d = before + (move[j] - move[i]);
            const Each<S> off = d2 - dot(d, d), g = 0.5f * off / ((mi + mj) * dot(d, before));
            worst = larger(worst, absolute(off) * (1.0f / d2));
            move[i] = move[i] - (g * mi) * before;
            move[j] = move[j] + (g * mj) * before;
        }
        if (largest<S>(worst) < b->tolerance) return 1;
    }
    return 0;
}

// SETTLE (Miyamoto and Kollman, J. Comput. Chem. 13, 952 (1992)), in its words, from the old oxygen as origin.
INLINE void place_water(const RigidWaters *b, const Replicas<float> *r, int o, V3 *move) {
    const float mo = b->masses[0], mh = b->masses[1], inverse_mass = b->masses[2], oh = b->legs[0], hh = b->legs[1];
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
static int slow(const Bath<float> *b, const RigidWaters *w, const Replicas<float> *r) {
    for (int o = b->n_atoms; o < b->n_atoms + 3 * w->n; o += 3) slow_water(w, r->x + o, r->v + o);
    return slow_bonds(b, r);
}

// What the bath gives the velocities of one atom after another, by each replica's own random numbers. Another struct may
// stand for it.
struct Streams {
    Random random;
    __attribute__((always_inline)) V3 operator()(const Bath<float> *b, int atom) {
        V z[4] = {};
        if (b->noise > 0.0f) {
            normals(&random, z, z + 1);
            normals(&random, z + 2, z + 3);
        }
        return b->noise * b->atoms[2 * atom + 1] * V3{z[0], z[1], z[2]};
    }
};

// The bath acts on one atom, which `move` says how far it goes.
template <class S, class Noise>
INLINE void drift(const Bath<S> *b, int atom, Noise *noise, Three<S> *v, Three<S> *move) {
    const Three<S> now = b->keep * *v + (*noise)(b, atom);
    *move = 0.5f * b->timestep * (*v + now);
    *v = now;
}

INLINE void move_on(V *x, V *low, V move) {
    const V s = *low + move, sum = rounded(*x + s);
    *low = s - (sum - *x);
    *x = sum;
}

// Positions after a move, and velocities after what constraints changed of it: v is what moved the atoms.
template <class S>
INLINE void arrive(const Bath<S> *b, const Replicas<S> *r, int i, Three<S> move, Three<S> free) {
    r->v[i] = r->v[i] + 1.0f / b->timestep * (move - free);
    if constexpr (sizeof(S) == 8) {
        r->x[i] = r->x[i] + move;
    } else {
        move_on(&r->x[i].x, &r->low[i].x, move.x);
        move_on(&r->x[i].y, &r->low[i].y, move.y);
        move_on(&r->x[i].z, &r->low[i].z, move.z);
    }
}

template <class S> INLINE void kick(const Bath<S> *b, const Replicas<S> *r, int i) {
    r->v[i] = r->v[i] + b->timestep * b->atoms[2 * i] * r->f[i];
}

// Brings the centre of mass to rest after the bath, which acts in the middle of a move.
template <class S>
static void rest(const Bath<S> *b, const Replicas<S> *r) {
    Three<S> mean = {};
    S mass = 0.0f;
    for (int i = 0; i < b->n_atoms; i++) {
        mean = mean + 1.0f / b->atoms[2 * i] * r->v[i];
        mass += 1.0f / b->atoms[2 * i];
    }
    mean = 1.0f / mass * mean;
    for (int i = 0; i < b->n_atoms; i++) {
        r->v[i] = r->v[i] - mean;
        r->move[i] = r->move[i] - 0.5f * b->timestep * mean;
    }
}

// One step of the bath's atoms with forces `r->f` at `r->x`. Returns 0 when rigid bonds cannot be met.
template <bool AT_REST, class S, class Noise>
static int advance(const Bath<S> *b, const Replicas<S> *r, Noise *noise) {
    Noise here = *noise;
    for (int i = 0; i < b->n_atoms; i++) kick(b, r, i);
    int met = slow_bonds(b, r);
    for (int i = 0; i < b->n_atoms; i++) drift(b, i, &here, r->v + i, r->move + i);
    if (AT_REST) rest(b, r);
    Three<S> *free = r->f;
    memcpy((void *)free, r->move, sizeof(Three<S>) * b->n_atoms);
    met &= place_bonds(b, r);
    for (int i = 0; i < b->n_atoms; i++) arrive(b, r, i, r->move[i], free[i]);
    *noise = here;
    return met;
}

// The same of rigid waters. Constraints act along the old bonds alone: what rounding in `place_water` leaves across these
// would slow rotation down by 2e-8 a step.
static void advance_waters(const Bath<float> *b, const RigidWaters *w, const Replicas<float> *r, Streams *noise) {
    Streams here = *noise;
    for (int o = b->n_atoms; o < b->n_atoms + 3 * w->n; o += 3) {
        V3 move[3], free[3], across[3];
        for (int k = 0; k < 3; k++) kick(b, r, o + k);
        slow_water(w, r->x + o, r->v + o);
        for (int k = 0; k < 3; k++) {
            drift(b, o + k, &here, r->v + o + k, move + k);
            free[k] = move[k];
        }
        place_water(w, r, o, move);
        for (int k = 0; k < 3; k++) across[k] = move[k] - free[k];
        slow_water(w, r->x + o, across);
        for (int k = 0; k < 3; k++) arrive(b, r, o + k, move[k] - across[k], free[k]);
    }
    *noise = here;
}
