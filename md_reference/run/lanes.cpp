// Molecular dynamics of one molecule in lanes: W copies of it, one in each element of a vector register.
//
// All arrays of coordinates are [n_atoms][3][W] floats. Terms are those of an openmm.System: harmonic bonds and angles,
// periodic torsions, Lennard-Jones and Coulomb between all pairs, GBSA-OBC. Units of OpenMM: nm, ps, Da, kJ/mol.
// Compiled by lanes.py at first use. No copy depends on what the others do, but for the number of iterations that
// constraints need.
#include <math.h>
#include <stdint.h>
#include <string.h>

#define W 16
#define LANES _Pragma("omp simd") for (int l = 0; l < W; l++)

extern "C" {

struct System {
    int32_t n_atoms, n_bonds, n_angles, n_torsions, n_constraints, born, n_biased;
    const int32_t *bonds;         // [n_bonds][2]
    const float *bond_terms;      // [n_bonds][2]: length, force constant
    const int32_t *angles;        // [n_angles][3]
    const float *angle_terms;     // [n_angles][2]: angle, force constant
    const int32_t *torsions;      // [n_torsions][4]
    const float *torsion_terms;   // [n_torsions][13]: constant, then of n = 1..6 the factors of cos and of sin
    const float *biases;          // [n_biased][2][W]: of the first torsions, each copy's own factors of cos and of sin
    const float *pairs;           // [n(n-1)/2][4], i < j: Coulomb, C12, C6, Born
    const float *atoms;           // [n_atoms][6]: 1/mass, thermal speed, radius, radius - offset, scaled radius, Born self
    const int32_t *constraints;   // [n_constraints][2]
    const float *lengths;         // [n_constraints]
    float surface, timestep, keep, noise;
    float *work;                  // [work_floats(n_atoms)]
};

int64_t work_floats(int64_t n) { return W * (3 * n + 3 * n + 3 * n + 4 * n + 2 * (n * (n - 1) / 2)); }
int32_t lanes(void) { return W; }

typedef float (*vec3)[3][W];
typedef float (*vec)[W];

static void bonds(const System *s, const vec3 x, vec3 f, double *energy) {
    for (int b = 0; b < s->n_bonds; b++) {
        const int i = s->bonds[2 * b], j = s->bonds[2 * b + 1];
        const float r0 = s->bond_terms[2 * b], k = s->bond_terms[2 * b + 1];
        LANES {
            const float dx = x[j][0][l] - x[i][0][l], dy = x[j][1][l] - x[i][1][l], dz = x[j][2][l] - x[i][2][l];
            const float r = sqrtf(dx * dx + dy * dy + dz * dz), g = k * (r - r0) / r;
            f[i][0][l] += g * dx; f[i][1][l] += g * dy; f[i][2][l] += g * dz;
            f[j][0][l] -= g * dx; f[j][1][l] -= g * dy; f[j][2][l] -= g * dz;
            if (energy) energy[l] += 0.5f * k * (r - r0) * (r - r0);
        }
    }
}

static void angles(const System *s, const vec3 x, vec3 f, double *energy) {
    for (int a = 0; a < s->n_angles; a++) {
        const int i = s->angles[3 * a], j = s->angles[3 * a + 1], k = s->angles[3 * a + 2];
        const float t0 = s->angle_terms[2 * a], stiff = s->angle_terms[2 * a + 1];
        LANES {
            const float ax = x[i][0][l] - x[j][0][l], ay = x[i][1][l] - x[j][1][l], az = x[i][2][l] - x[j][2][l];
            const float bx = x[k][0][l] - x[j][0][l], by = x[k][1][l] - x[j][1][l], bz = x[k][2][l] - x[j][2][l];
            const float ra = 1.0f / sqrtf(ax * ax + ay * ay + az * az), rb = 1.0f / sqrtf(bx * bx + by * by + bz * bz);
            float c = (ax * bx + ay * by + az * bz) * ra * rb;
            c = c > 0.999999f ? 0.999999f : (c < -0.999999f ? -0.999999f : c);
            const float theta = acosf(c), d = theta - t0;
            // dE/dtheta * dtheta/dcos, theta' = -1/sin.
            const float g = stiff * d / sqrtf(1.0f - c * c), ga = g * ra, gb = g * rb;
            const float fix = ga * (bx * rb - c * ax * ra), fiy = ga * (by * rb - c * ay * ra), fiz = ga * (bz * rb - c * az * ra);
            const float fkx = gb * (ax * ra - c * bx * rb), fky = gb * (ay * ra - c * by * rb), fkz = gb * (az * ra - c * bz * rb);
            f[i][0][l] += fix; f[i][1][l] += fiy; f[i][2][l] += fiz;
            f[k][0][l] += fkx; f[k][1][l] += fky; f[k][2][l] += fkz;
            f[j][0][l] -= fix + fkx; f[j][1][l] -= fiy + fky; f[j][2][l] -= fiz + fkz;
            if (energy) energy[l] += 0.5f * stiff * d * d;
        }
    }
}

static void torsions(const System *s, const vec3 x, vec3 f, double *energy) {
    for (int t = 0; t < s->n_torsions; t++) {
        const int32_t *q = s->torsions + 4 * t;
        const int i = q[0], j = q[1], k = q[2], m = q[3];
        const float *p = s->torsion_terms + 13 * t;
        static const float none[2 * W] = {0};
        const float *own = t < s->n_biased ? s->biases + 2 * W * t : none;
        LANES {
            const float ax = x[j][0][l] - x[i][0][l], ay = x[j][1][l] - x[i][1][l], az = x[j][2][l] - x[i][2][l];
            const float bx = x[k][0][l] - x[j][0][l], by = x[k][1][l] - x[j][1][l], bz = x[k][2][l] - x[j][2][l];
            const float cx = x[m][0][l] - x[k][0][l], cy = x[m][1][l] - x[k][1][l], cz = x[m][2][l] - x[k][2][l];
            const float ux = ay * bz - az * by, uy = az * bx - ax * bz, uz = ax * by - ay * bx;
            const float wx = by * cz - bz * cy, wy = bz * cx - bx * cz, wz = bx * cy - by * cx;
            const float b2 = bx * bx + by * by + bz * bz, bn = sqrtf(b2);
            const float u2 = 1.0f / (ux * ux + uy * uy + uz * uz), w2 = 1.0f / (wx * wx + wy * wy + wz * wz);
            const float uw = sqrtf(u2 * w2);
            const float c = (ux * wx + uy * wy + uz * wz) * uw;
            const float sn = bn * (ax * wx + ay * wy + az * wz) * uw;
            float cn = 1.0f, sm = 0.0f, slope = own[W + l] * c - own[l] * sn, sum = p[0] + own[l] * c + own[W + l] * sn;
            for (int n = 1; n <= 6; n++) {
                const float next = cn * c - sm * sn;
                sm = sm * c + cn * sn;
                cn = next;
                slope += n * (p[2 * n] * cn - p[2 * n - 1] * sm);
                sum += p[2 * n - 1] * cn + p[2 * n] * sm;
            }
            // Blondel and Karplus, J. Comput. Chem. 17, 1132 (1996).
            const float fi = -slope * bn * u2, fm = slope * bn * w2;
            const float ab = (ax * bx + ay * by + az * bz) / b2, cb = (cx * bx + cy * by + cz * bz) / b2;
            const float gix = -fi * ux, giy = -fi * uy, giz = -fi * uz;
            const float gmx = -fm * wx, gmy = -fm * wy, gmz = -fm * wz;
            const float tx = cb * gmx - ab * gix, ty = cb * gmy - ab * giy, tz = cb * gmz - ab * giz;
            f[i][0][l] += gix; f[i][1][l] += giy; f[i][2][l] += giz;
            f[m][0][l] += gmx; f[m][1][l] += gmy; f[m][2][l] += gmz;
            f[j][0][l] += -gix + tx; f[j][1][l] += -giy + ty; f[j][2][l] += -giz + tz;
            f[k][0][l] += -gmx - tx; f[k][1][l] += -gmy - ty; f[k][2][l] += -gmz - tz;
            if (energy) energy[l] += sum;
        }
    }
}

// OBC (Onufriev, Bashford and Case, Proteins 55, 383 (2004), set II): one atom's share of another's Born sum, and the
// derivative of that share by the distance, over the distance.
static inline __attribute__((always_inline)) void screen(
    float r, float own, float other, float *share, float *slope) {
    const float rinv = 1.0f / r, gap = fabsf(r - other), low = own > gap ? own : gap;
    const float lo = 1.0f / low, up = 1.0f / (r + other), lo2 = lo * lo, up2 = up * up, ratio = logf(up * low);
    const float o2 = other * other;
    const float term = lo - up + 0.25f * (r - o2 * rinv) * (up2 - lo2) + 0.5f * rinv * ratio
        + (own < other - r ? 2.0f * (1.0f / own - lo) : 0.0f);
    const float seen = own < r + other ? 1.0f : 0.0f;
    *share = seen * term;
    *slope = seen * (0.125f * (1.0f + o2 * rinv * rinv) * (lo2 - up2) + 0.25f * ratio * rinv * rinv) * rinv;
}

static void pairs(const System *s, const vec3 x, vec3 f, vec born, double *energy) {
    const int n = s->n_atoms;
    vec pull = born + n, chain = born + 2 * n, slopes = born + 4 * n;
    const float *a = s->atoms;
    if (s->born) {
        vec sum = born + 3 * n;
        memset(sum, 0, sizeof(float) * W * n);
        int p = 0;
        for (int i = 0; i < n; i++)
            for (int j = i + 1; j < n; j++, p++) {
                const float oi = a[6 * i + 3], si = a[6 * i + 4], oj = a[6 * j + 3], sj = a[6 * j + 4];
                LANES {
                    const float dx = x[j][0][l] - x[i][0][l], dy = x[j][1][l] - x[i][1][l], dz = x[j][2][l] - x[i][2][l];
                    const float r = sqrtf(dx * dx + dy * dy + dz * dz);
                    float to_i, to_j, slope_i, slope_j;
                    screen(r, oi, sj, &to_i, &slope_i);
                    screen(r, oj, si, &to_j, &slope_j);
                    sum[i][l] += to_i;
                    sum[j][l] += to_j;
                    slopes[2 * p][l] = slope_i;
                    slopes[2 * p + 1][l] = slope_j;
                }
            }
        for (int i = 0; i < n; i++) {
            const float radius = a[6 * i + 2], offset = a[6 * i + 3], self = a[6 * i + 5], reach = radius + 0.14f;
            LANES {
                const float psi = 0.5f * offset * sum[i][l];
                const float t = tanhf(psi * (1.0f + psi * (-0.8f + psi * 4.85f)));
                const float b = 1.0f / (1.0f / offset - t / radius);
                born[i][l] = b;
                chain[i][l] = b * b * (1.0f - t * t) * offset * (1.0f + psi * (-1.6f + psi * 14.55f)) / radius;
                const float ratio = radius / b, area = s->surface * reach * reach * ratio * ratio * ratio * ratio * ratio * ratio;
                // The self term is half of self / b.
                pull[i][l] = -0.5f * self / (b * b) - 6.0f * area / b;
                if (energy) energy[l] += 0.5f * self / b + area;
            }
        }
    }
    const float *q = s->pairs;
    for (int i = 0; i < n; i++)
        for (int j = i + 1; j < n; j++, q += 4) {
            const float qq = q[0], c12 = q[1], c6 = q[2], qb = q[3];
            LANES {
                const float dx = x[j][0][l] - x[i][0][l], dy = x[j][1][l] - x[i][1][l], dz = x[j][2][l] - x[i][2][l];
                const float r2 = dx * dx + dy * dy + dz * dz, inv2 = 1.0f / r2, inv = sqrtf(inv2), inv6 = inv2 * inv2 * inv2;
                const float coulomb = qq * inv, repel = c12 * inv6 * inv6, attract = c6 * inv6;
                // Minus the derivative of the energy, over r.
                float g = (coulomb + 12.0f * repel - 6.0f * attract) * inv2;
                float e = coulomb + repel - attract;
                if (s->born) {
                    const float bb = born[i][l] * born[j][l], d = 0.25f * r2 / bb, damp = expf(-d);
                    const float finv2 = 1.0f / (r2 + bb * damp), polar = qb * sqrtf(finv2);
                    g += polar * (1.0f - 0.25f * damp) * finv2;
                    const float by_bb = -0.5f * polar * damp * (1.0f + d) * finv2;
                    pull[i][l] += by_bb * born[j][l];
                    pull[j][l] += by_bb * born[i][l];
                    e += polar;
                }
                f[i][0][l] -= g * dx; f[i][1][l] -= g * dy; f[i][2][l] -= g * dz;
                f[j][0][l] += g * dx; f[j][1][l] += g * dy; f[j][2][l] += g * dz;
                if (energy) energy[l] += e;
            }
        }
    if (!s->born) return;
    for (int i = 0; i < n; i++) LANES pull[i][l] *= chain[i][l];
    int p = 0;
    for (int i = 0; i < n; i++)
        for (int j = i + 1; j < n; j++, p++) LANES {
                const float g = pull[i][l] * slopes[2 * p][l] + pull[j][l] * slopes[2 * p + 1][l];
                const float dx = x[j][0][l] - x[i][0][l], dy = x[j][1][l] - x[i][1][l], dz = x[j][2][l] - x[i][2][l];
                f[i][0][l] -= g * dx; f[i][1][l] -= g * dy; f[i][2][l] -= g * dz;
                f[j][0][l] += g * dx; f[j][1][l] += g * dy; f[j][2][l] += g * dz;
            }
}

// Forces [n][3][W], and where `energy` is not null the energy of each lane.
void forces(const System *s, const float *positions, float *out, double *energy) {
    const vec3 x = (vec3)positions, f = (vec3)out;
    memset(out, 0, sizeof(float) * W * 3 * s->n_atoms);
    if (energy) memset(energy, 0, sizeof(double) * W);
    bonds(s, x, f, energy);
    angles(s, x, f, energy);
    torsions(s, x, f, energy);
    pairs(s, x, f, (vec)(s->work + W * 9 * s->n_atoms), energy);
}

// SHAKE (Ryckaert, Ciccotti and Berendsen, J. Comput. Phys. 23, 327 (1977)) along the bonds of `from`.
static int constrain_positions(const System *s, const vec3 from, vec3 x) {
    for (int round = 0; round < 200; round++) {
        float worst[W] = {0};
        for (int c = 0; c < s->n_constraints; c++) {
            const int i = s->constraints[2 * c], j = s->constraints[2 * c + 1];
            const float d2 = s->lengths[c] * s->lengths[c], mi = s->atoms[6 * i], mj = s->atoms[6 * j];
            LANES {
                const float dx = x[j][0][l] - x[i][0][l], dy = x[j][1][l] - x[i][1][l], dz = x[j][2][l] - x[i][2][l];
                const float rx = from[j][0][l] - from[i][0][l], ry = from[j][1][l] - from[i][1][l], rz = from[j][2][l] - from[i][2][l];
                const float off = d2 - (dx * dx + dy * dy + dz * dz), bad = fabsf(off) / d2;
                worst[l] = bad > worst[l] ? bad : worst[l];
                const float g = 0.5f * off / ((mi + mj) * (dx * rx + dy * ry + dz * rz));
                x[i][0][l] -= g * mi * rx; x[i][1][l] -= g * mi * ry; x[i][2][l] -= g * mi * rz;
                x[j][0][l] += g * mj * rx; x[j][1][l] += g * mj * ry; x[j][2][l] += g * mj * rz;
            }
        }
        float most = 0;
        for (int l = 0; l < W; l++) most = worst[l] > most ? worst[l] : most;
        if (most < 1e-5f) return 1;
    }
    return 0;
}

// RATTLE (Andersen, J. Comput. Phys. 52, 24 (1983)), its velocities.
int32_t constrain_velocities(const System *s, const float *positions, float *velocities) {
    const vec3 x = (vec3)positions, v = (vec3)velocities;
    for (int round = 0; round < 200; round++) {
        float worst[W] = {0};
        for (int c = 0; c < s->n_constraints; c++) {
            const int i = s->constraints[2 * c], j = s->constraints[2 * c + 1];
            const float d2 = s->lengths[c] * s->lengths[c], mi = s->atoms[6 * i], mj = s->atoms[6 * j];
            LANES {
                const float dx = x[j][0][l] - x[i][0][l], dy = x[j][1][l] - x[i][1][l], dz = x[j][2][l] - x[i][2][l];
                const float along = (v[j][0][l] - v[i][0][l]) * dx + (v[j][1][l] - v[i][1][l]) * dy + (v[j][2][l] - v[i][2][l]) * dz;
                const float bad = fabsf(along) * s->timestep / d2, g = -along / ((mi + mj) * d2);
                worst[l] = bad > worst[l] ? bad : worst[l];
                v[i][0][l] -= g * mi * dx; v[i][1][l] -= g * mi * dy; v[i][2][l] -= g * mi * dz;
                v[j][0][l] += g * mj * dx; v[j][1][l] += g * mj * dy; v[j][2][l] += g * mj * dz;
            }
        }
        float most = 0;
        for (int l = 0; l < W; l++) most = worst[l] > most ? worst[l] : most;
        if (most < 1e-6f) return 1;
    }
    return 0;
}

// xoshiro128+ (Blackman and Vigna, ACM Trans. Math. Softw. 47, 36 (2021)), a stream for each lane: [4][W].
static inline __attribute__((always_inline)) uint32_t draw(uint32_t (*state)[W], int l) {
    const uint32_t result = state[0][l] + state[3][l], t = state[1][l] << 9;
    state[2][l] ^= state[0][l]; state[3][l] ^= state[1][l]; state[1][l] ^= state[2][l]; state[0][l] ^= state[3][l];
    state[2][l] ^= t;
    state[3][l] = (state[3][l] << 11) | (state[3][l] >> 21);
    return result;
}

// Standard normal numbers [count][W] (Box and Muller); count is even.
static void normals(uint32_t *random, float *out, int count) {
    uint32_t (*state)[W] = (uint32_t (*)[W])random;
    vec o = (vec)out;
    for (int k = 0; k < count; k += 2) {
        float r[W], turn[W];
        LANES {
            const float u = ((draw(state, l) >> 8) + 1) * 0x1p-24f;
            turn[l] = (int32_t)(draw(state, l) >> 8) * (6.28318530718f * 0x1p-24f);
            r[l] = sqrtf(-2.0f * logf(u));
        }
        // Two loops: in one the compiler joins sine and cosine to a call that it cannot vectorise.
        LANES o[k][l] = r[l] * cosf(turn[l]);
        LANES o[k + 1][l] = r[l] * sinf(turn[l]);
    }
}

// Langevin middle (Zhang et al., J. Phys. Chem. A 123, 6056 (2019)) with constraints, as OpenMM's integrator has it.
// Returns 0, or 1 + the step at which constraints could not be met.
int64_t step(const System *s, float *positions, float *velocities, uint32_t *random, int64_t n_steps) {
    const int n = s->n_atoms;
    const float half = 0.5f * s->timestep;
    vec3 x = (vec3)positions, v = (vec3)velocities, f = (vec3)s->work;
    vec3 from = (vec3)(s->work + W * 3 * n), loose = (vec3)(s->work + W * 6 * n);
    for (int64_t k = 0; k < n_steps; k++) {
        forces(s, positions, (float *)f, 0);
        for (int i = 0; i < n; i++)
            for (int d = 0; d < 3; d++) LANES v[i][d][l] += s->timestep * s->atoms[6 * i] * f[i][d][l];
        if (!constrain_velocities(s, positions, velocities)) return k + 1;
        memcpy(from, x, sizeof(float) * W * 3 * n);
        // Behind the arrays above lies what forces need while they are computed.
        float *noise = s->work + W * 9 * n;
        if (s->noise > 0) normals(random, noise, 3 * n + (n & 1));
        for (int i = 0; i < n; i++)
            for (int d = 0; d < 3; d++) {
                const float speed = s->noise * s->atoms[6 * i + 1];
                const float *z = noise + W * (3 * i + d);
                LANES {
                    const float old = v[i][d][l], now = s->keep * old + (speed > 0 ? speed * z[l] : 0.0f);
                    v[i][d][l] = now;
                    x[i][d][l] += half * (old + now);
                    loose[i][d][l] = x[i][d][l];
                }
            }
        if (s->n_constraints) {
            if (!constrain_positions(s, from, x)) return k + 1;
            for (int i = 0; i < n; i++)
                for (int d = 0; d < 3; d++) LANES v[i][d][l] += (x[i][d][l] - loose[i][d][l]) / s->timestep;
        }
    }
    return 0;
}
}
