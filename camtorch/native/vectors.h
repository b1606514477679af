/* LANES numbers at a time, and four: their types, and what is done to all of them alike. Not what they mean. */
#if defined(__AVX2__)
#include <immintrin.h>
#elif defined(__aarch64__) && !defined(CAMTORCH_PLAIN)
#include <arm_neon.h>
#define NEON 1
#endif
#if !defined(NEON)
#define NEON 0
#endif
#if defined(CAMTORCH_PLAIN)
#define VECTORS 0
#else
#define VECTORS 1
#endif
#if defined(__AVX512VBMI__) && defined(__AVX512VL__) && defined(__AVX512BW__) && defined(__AVX512DQ__)
#define WIDE 1
#else
#define WIDE 0
#endif

/* GCC makes two registers of a vector that is twice as long for x86; for ARM it takes such a vector apart */
#if NEON
enum { LANES = 4 };
#else
enum { LANES = 8 };
#endif

#if VECTORS

typedef float Floats __attribute__((vector_size(4 * LANES)));
typedef int32_t Wholes __attribute__((vector_size(4 * LANES)));
typedef float V4 __attribute__((vector_size(16)));

INLINE Floats load_floats(const float *from) {
    Floats value;
    memcpy(&value, from, sizeof value);
    return value;
}

INLINE V4 load4(const float *from) {
    V4 value;
    memcpy(&value, from, sizeof value);
    return value;
}

INLINE Floats every(float value) { return value - (Floats){0}; }
INLINE Wholes every_whole(int32_t value) { return value - (Wholes){0}; }
INLINE V4 every4(float value) { return value - (V4){0}; }
INLINE Wholes truncated(Floats value) { return __builtin_convertvector(value, Wholes); }
INLINE Floats as_floats(Wholes value) { return __builtin_convertvector(value, Floats); }

/* A bit for each that is true */
INLINE int true_lanes(Wholes mask) {
#if defined(__AVX2__)
    return _mm256_movemask_ps((__m256)mask);
#elif NEON
    return vaddvq_s32(vandq_s32(mask, (int32x4_t){1, 2, 4, 8}));
#else
    int lanes = 0, i;
    for (i = 0; i < LANES; i++) lanes |= (mask[i] != 0) << i;
    return lanes;
#endif
}

INLINE int all_true(Wholes mask) {
#if defined(__AVX2__)
    return true_lanes(mask) == 0xff;
#elif NEON
    return vminvq_u32((uint32x4_t)mask) != 0;
#else
    int64_t parts[4];
    memcpy(parts, &mask, sizeof parts);
    return (parts[0] & parts[1] & parts[2] & parts[3]) == -1;
#endif
}

INLINE Wholes lesser_of(Wholes a, Wholes b) {
    const Wholes less = a < b;
    return (a & less) | (b & ~less);
}

/* What is not a number fails every comparison, and stays */
INLINE Floats clamped_all(Floats x, float last) {
#if defined(__AVX2__)
    return (Floats)_mm256_max_ps(_mm256_setzero_ps(), _mm256_min_ps(_mm256_set1_ps(last), (__m256)x));
#endif
    const Wholes low = x < every(0), high = x > every(last);
    return (Floats)(((Wholes)x & ~low & ~high) | ((Wholes)every(last) & high));
}

/* See `reflected`; of numbers whose size is below 2^21 */
INLINE Floats reflected_all(Floats x, float side) {
    Floats distance = (Floats)((Wholes)(x + 0.5f) & 0x7fffffff), sides = distance / side, extra;
    const Wholes whole = truncated(sides);
    extra = distance - as_floats(whole) * side;
    extra = (Floats)(((Wholes)(side - extra) & -(whole & 1)) | ((Wholes)extra & ~-(whole & 1)));
    return clamped_all(extra - 0.5f, side - 1);
}

/* To the nearest whole number, of numbers whose size is below 2^22 */
INLINE Wholes rounded_all(Floats value) {
    const Floats large = every(12582912.0f);
    Floats sum = value + large;
    return (Wholes)sum - (Wholes)large;
}

/* True from one half on, as bytes */
INLINE Wholes truth(Floats value) { return -(value >= every(0.5f)); }

#if defined(__AVX2__)

/* Four times eight bytes, of any places */
INLINE __m256i quarters(const char *a, const char *b, const char *c, const char *d) {
#define EVERYWHERE(from) _mm256_castpd_si256(_mm256_broadcast_sd((const double *)(from)))
    const __m256i first = _mm256_blend_epi32(EVERYWHERE(a), EVERYWHERE(b), 0x0c);
    const __m256i second = _mm256_blend_epi32(EVERYWHERE(c), EVERYWHERE(d), 0xc0);
#undef EVERYWHERE
    return _mm256_blend_epi32(first, second, 0xf0);
}

#endif

#endif
