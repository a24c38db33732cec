// Molecular dynamics of W replicas of one scene by a molecular mechanics force field: of a molecule in vacuum or
// GBSA-OBC, or of a solute in a periodic cell of water. Compiled by force_field.py at first use.
//
// Arrays of coordinates are [n_atoms][3][W] floats. No replica depends on what the others do, but for the number of
// iterations that rigid bonds need and, in water, for the order in which terms are added.
#include "bath.h"
#include "molecule.h"
#include "pme.h"
#include "water.h"

struct System {
    Bath<float> bath;
    RigidWaters rigid;
    Molecule molecule;
    Water water;
    Mesh mesh;
    int32_t periodic, listed_steps;
    double constant;  // of the energy
};

static int n_atoms(const System *s) { return s->bath.n_atoms + 3 * s->rigid.n; }

// Forces at x, and where `energy` is not null that of each replica.
static void evaluate(const System *s, const V3 *x, V3 *f, double *energy) {
    memset((void *)f, 0, sizeof(V3) * n_atoms(s));
    if (energy)
        for (int l = 0; l < W; l++) energy[l] = s->constant;
    bonded(&s->molecule, x, f, energy);
    if (s->periodic) {
        direct(&s->water, x, f, energy);
        if (s->water.ewald) reciprocal(&s->mesh, x, f, energy);
    } else if (s->molecule.born) {
        pairs<true>(&s->molecule, x, f, energy);
    } else {
        pairs<false>(&s->molecule, x, f, energy);
    }
}

extern "C" {
int32_t replicas(void) { return W; }
int64_t work_floats(int64_t n_atoms) { return W * molecule_work(n_atoms); }
// Sizes, so that Python may notice where its structures differ from these.
int64_t size_of_system(void) { return sizeof(System); }

void forces(const System *s, const float *x, float *f, double *energy) {
    if (s->periodic) list_pairs(&s->water, (const V3 *)x);
    evaluate(s, (const V3 *)x, (V3 *)f, energy);
}

int32_t constrain_velocities(const System *s, float *x, float *v) {
    Replicas<float> r = {(V3 *)x, 0, (V3 *)v, 0, 0};
    return slow(&s->bath, &s->rigid, &r);
}

// Returns 0, or 1 + the step at which rigid bonds could not be met. `room` is [2][n_atoms][3][W].
int64_t step(const System *s, float *x, float *low, float *v, uint32_t *random, float *room, int64_t n_steps) {
    Replicas<float> r = {(V3 *)x, (V3 *)low, (V3 *)v, (V3 *)room, (V3 *)room + n_atoms(s)};
    Streams *noise = (Streams *)random;
    for (int64_t k = 0; k < n_steps; k++) {
        if (s->periodic && k % s->listed_steps == 0) {
            trade(&s->water, r.x, r.low, r.v);
            list_pairs(&s->water, r.x);
        }
        evaluate(s, r.x, r.f, 0);
        if (!advance<false>(&s->bath, &r, noise)) return k + 1;
        advance_waters(&s->bath, &s->rigid, &r, noise);
    }
    return 0;
}

// One part of a step in water, again and again, for `docs/studies/water/speed.py`. Returns how many pairs are listed.
int64_t part(const System *s, int32_t which, float *x, float *f, int64_t times) {
    const Mesh *m = &s->mesh;
    int64_t n = 0;
    for (int64_t k = 0; k < times; k++) switch (which) {
        case 0: n = list_pairs(&s->water, (V3 *)x); break;
        case 1: find_middles(&s->water, (V3 *)x), waters<false>(&s->water, (V3 *)x, (V3 *)f, 0); break;
        case 2: solute_and_water<false>(&s->water, (V3 *)x, (V3 *)f, 0); break;
        case 3: within(&s->water, (V3 *)x, (V3 *)f, 0), bonded(&s->molecule, (V3 *)x, (V3 *)f, 0); break;
        case 4: locate(m, (V3 *)x), spread(m); break;
        case 5: convolve(m, 0); break;
        case 6: gather(m, (V3 *)f); break;
    }
    return n;
}
}
