// A register's worth of replicas: one number of each in a V, and the few functions that a compiler does not vectorise.
//
// W, the number of replicas, is 16 with AVX-512, 8 with AVX2 and 4 elsewhere (NEON, SSE), unless the compiler is told.
// Where that is more than a register holds, a V is several.
#pragma once
#include <math.h>
#include <stdint.h>
#include <string.h>
#if defined(__AVX__)
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

#ifndef W
#if defined(__AVX512F__)
#define W 16
#elif defined(__AVX2__)
#define W 8
#else
#define W 4
#endif
#endif
#if W == 16 && defined(__AVX512F__)
#define AVX512
#elif W == 8 && defined(__AVX2__)
#define AVX2
#elif W == 4 && defined(__ARM_NEON)
#define NEON
#endif
#define INLINE static inline __attribute__((always_inline))

typedef float V __attribute__((vector_size(4 * W), may_alias));
typedef int32_t I __attribute__((vector_size(4 * W), may_alias));
typedef uint32_t U __attribute__((vector_size(4 * W), may_alias));
// As numpy and torch lay arrays.
typedef double D __attribute__((vector_size(8 * W), aligned(8), may_alias));
typedef float Vu __attribute__((vector_size(4 * W), aligned(4), may_alias));
typedef float V8 __attribute__((vector_size(32), may_alias));
typedef float V8u __attribute__((vector_size(32), may_alias, aligned(4)));

// A number for each replica in single or double precision, and a vector of three.
template <class S> struct Register { typedef V type; };
template <> struct Register<double> { typedef D type; };
template <class S> using Each = typename Register<S>::type;
template <class S> struct __attribute__((may_alias)) Three { Each<S> x, y, z; };
typedef Three<float> V3;

INLINE V splat(float a) { return a - (V){}; }
template <class S> INLINE Three<S> operator-(Three<S> a, Three<S> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <class S> INLINE Three<S> operator+(Three<S> a, Three<S> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class S> INLINE Three<S> operator*(Each<S> s, Three<S> a) { return {s * a.x, s * a.y, s * a.z}; }
template <class S> INLINE Three<S> operator*(S s, Three<S> a) { return {s * a.x, s * a.y, s * a.z}; }
template <class S> INLINE Each<S> dot(Three<S> a, Three<S> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE V3 cross(V3 a, V3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

// Keeps what was rounded from being reassociated by fast mathematics.
INLINE V rounded(V a) {
#ifdef AVX512
    asm("" : "+v"(a));
#elif defined(__x86_64__)
    asm("" : "+x"(a));
#else
    asm("" : "+w"(a));
#endif
    return a;
}
// Nearest whole number, of up to 2^22.
INLINE V nearest(V a) { return rounded(a + 12582912.0f) - 12582912.0f; }

INLINE V root(V a) {
#ifdef AVX512
    return (V)_mm512_sqrt_ps((__m512)a);
#elif defined(AVX2)
    return (V)_mm256_sqrt_ps((__m256)a);
#else
    V b;
    for (int l = 0; l < W; l++) b[l] = __builtin_sqrtf(a[l]);
    return b;
#endif
}

// 1 / sqrt(a) to 1e-4 or better.
INLINE V root_estimate(V a) {
#ifdef AVX512
    return (V)_mm512_rsqrt14_ps((__m512)a);
#elif defined(AVX2)
    return (V)_mm256_rsqrt_ps((__m256)a);
#elif defined(NEON)
    const V y = (V)vrsqrteq_f32((float32x4_t)a);
    return 0.5f * y * (3.0f - a * y * y);
#else
    V y;
    for (int l = 0; l < W; l++) y[l] = 1.0f / __builtin_sqrtf(a[l]);
    return y;
#endif
}

// 2 / sqrt(a) to single precision, by a Newton step.
INLINE V two_over_root(V a) {
    const V y = root_estimate(a);
    return y * (3.0f - (a * y) * y);
}

template <class S> INLINE S largest(Each<S> a) {
    S most = a[0];
    for (int l = 1; l < W; l++) most = a[l] > most ? a[l] : most;
    return most;
}
INLINE V larger(V a, V b) { return a > b ? a : b; }
INLINE D larger(D a, D b) { return a > b ? a : b; }
INLINE V smaller(V a, V b) { return a < b ? a : b; }
INLINE V absolute(V a) { return (V)((I)a & 0x7fffffff); }
INLINE D absolute(D a) { return a < 0.0 ? -a : a; }
INLINE bool any(I mask) {
#ifdef AVX512
    return _mm512_test_epi32_mask((__m512i)mask, (__m512i)mask) != 0;
#else
    int32_t found = 0;
    for (int l = 0; l < W; l++) found |= mask[l];
    return found != 0;
#endif
}

// A function that the compiler knows for whole registers.
#define BY_ELEMENT(name, function) \
    INLINE V name(V a) { \
        float in[W], out[W]; \
        memcpy(in, &a, sizeof a); \
        _Pragma("omp simd") for (int l = 0; l < W; l++) out[l] = function(in[l]); \
        memcpy(&a, out, sizeof a); \
        return a; \
    }
BY_ELEMENT(exponential, expf)
BY_ELEMENT(log_ratio, logf)
BY_ELEMENT(hyperbolic, tanhf)
BY_ELEMENT(arc_cosine, acosf)

INLINE void add_to(double *sum, V a) {
    for (int l = 0; l < W; l++) sum[l] += (double)a[l];
}

// Element (i, j) of W rows becomes (j, i).
INLINE void transpose(V *rows) {
    for (int s = 1; s < W; s *= 2) {
        U low, high;
        for (int l = 0; l < W; l++) {
            low[l] = l & s ? W + l - s : l;
            high[l] = l & s ? W + l : l + s;
        }
        for (int i = 0; i < W; i++) {
            if (i & s) continue;
            const V a = rows[i], b = rows[i + s];
            rows[i] = __builtin_shuffle(a, b, (I)low);
            rows[i + s] = __builtin_shuffle(a, b, (I)high);
        }
    }
}

// xoshiro128+ (Blackman and Vigna, ACM Trans. Math. Softw. 47, 36 (2021)), a stream for each replica.
struct Random { U s[4]; };

INLINE U draw(Random *r) {
    const U result = r->s[0] + r->s[3], t = r->s[1] << 9;
    r->s[2] ^= r->s[0]; r->s[3] ^= r->s[1]; r->s[1] ^= r->s[2]; r->s[0] ^= r->s[3];
    r->s[2] ^= t;
    r->s[3] = (r->s[3] << 11) | (r->s[3] >> 21);
    return result;
}

// Natural logarithm of 0 < a < 2^126, to 1e-7 (relative near 1: of a - 1).
INLINE V logarithm(V a) {
    I bits = (I)a;
    const I up = (bits & 0x7fffff) > 0x3504f3;  // mantissa above sqrt(2)
    I exponent = (bits >> 23) - 127 - up;
    V m = (V)((bits & 0x7fffff) | 0x3f800000);
    m = up ? 0.5f * m : m;
    const V f = m - 1.0f, s = f / (2.0f + f), z = s * s;
    const V p = z * (0.6666666667f + z * (0.4f + z * (0.2857142857f + z * (0.2222222222f + z * 0.18181818f))));
    return 2.0f * s + s * p + 0.6931471806f * __builtin_convertvector(exponent, V);
}

// Two independent standard normal numbers for each replica (Box and Muller).
INLINE void normals(Random *random, V *one, V *other) {
    const V u = __builtin_convertvector((I)((draw(random) >> 8) + 1), V) * 0x1p-24f;
    // Quarter turns from the nearest axis: |f| <= 1/2.
    const U turn = draw(random) >> 8;
    const I axis = (I)((turn + 0x200000) >> 22);
    const V f = __builtin_convertvector((I)turn - (axis << 22), V) * 0x1p-22f, z = f * f;
    const V sine = f * (1.5707963268f + z * (-0.6459640975f + z * (0.0796926262f + z * (-0.0046817541f + z * 0.00016044118f))));
    const V cosine = 1.0f + z * (-1.2337005501f + z * (0.2536695079f + z * (-0.0208634807f + z * (0.00091926f - z * 2.52e-5f))));
    const V r = root(-2.0f * logarithm(u));
    const I swapped = (axis & 1) != 0;
    const V s = swapped ? cosine : sine, c = swapped ? sine : cosine;
    *one = r * ((axis & 2) != 0 ? -s : s);
    *other = r * (((axis + 1) & 2) != 0 ? -c : c);
}
