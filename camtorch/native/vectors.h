/* Eight numbers at a time, and four: their types, and what is done to all of them alike. Not what they mean. */
#if defined(__AVX2__)
#include <immintrin.h>
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

#if VECTORS

typedef float V8 __attribute__((vector_size(32)));
typedef int32_t I8 __attribute__((vector_size(32)));
typedef float V4 __attribute__((vector_size(16)));
typedef int32_t I4 __attribute__((vector_size(16)));

INLINE V8 load8(const float *from) {
    V8 value;
    memcpy(&value, from, sizeof value);
    return value;
}

INLINE V4 load4(const float *from) {
    V4 value;
    memcpy(&value, from, sizeof value);
    return value;
}

INLINE V8 every8(float value) { return (V8){value, value, value, value, value, value, value, value}; }
INLINE I8 every8i(int32_t value) { return (I8){value, value, value, value, value, value, value, value}; }
INLINE V4 every4(float value) { return (V4){value, value, value, value}; }
INLINE I8 whole8(V8 value) { return __builtin_convertvector(value, I8); }
INLINE V8 float8(I8 value) { return __builtin_convertvector(value, V8); }
INLINE V4 float4(I4 value) { return __builtin_convertvector(value, V4); }

/* A bit for each that is true */
INLINE int lanes8(I8 mask) {
#if defined(__AVX2__)
    return _mm256_movemask_ps((__m256)mask);
#else
    int lanes = 0, i;
    for (i = 0; i < STEP; i++) lanes |= (mask[i] != 0) << i;
    return lanes;
#endif
}

INLINE int all8(I8 mask) {
#if defined(__AVX2__)
    return lanes8(mask) == 0xff;
#else
    int64_t parts[4];
    memcpy(parts, &mask, sizeof parts);
    return (parts[0] & parts[1] & parts[2] & parts[3]) == -1;
#endif
}

INLINE I8 least8(I8 a, I8 b) {
    const I8 less = a < b;
    return (a & less) | (b & ~less);
}

/* What is not a number fails every comparison, and stays */
INLINE V8 clamped8(V8 x, float last) {
#if defined(__AVX2__)
    return (V8)_mm256_max_ps(_mm256_setzero_ps(), _mm256_min_ps(_mm256_set1_ps(last), (__m256)x));
#endif
    const I8 low = x < every8(0), high = x > every8(last);
    return (V8)(((I8)x & ~low & ~high) | ((I8)every8(last) & high));
}

/* See `reflected`; of numbers whose size is below 2^21 */
INLINE V8 reflected8(V8 x, float side) {
    V8 distance = (V8)((I8)(x + 0.5f) & 0x7fffffff), sides = distance / side, extra;
    const I8 whole = whole8(sides);
    extra = distance - float8(whole) * side;
    extra = (V8)(((I8)(side - extra) & -(whole & 1)) | ((I8)extra & ~-(whole & 1)));
    return clamped8(extra - 0.5f, side - 1);
}

/* To the nearest whole number, of numbers whose size is below 2^22 */
INLINE I8 rounded8(V8 value) {
    const V8 large = every8(12582912.0f);
    V8 sum = value + large;
    return (I8)sum - (I8)large;
}

/* True from one half on, as bytes */
INLINE I8 truth8(V8 value) { return -(value >= every8(0.5f)); }

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
