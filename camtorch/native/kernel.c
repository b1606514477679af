/* Samples images where a warp says, in tiles of rows: one variant, for the instructions that it is compiled for.
 *
 * A tile goes by columns of chunks, STEP rows of which are made for one image after the other. Positions come from a
 * grid or from a lattice, between whose nodes lie cubics. Pixels are made eight at a time in floats (`eight`), with
 * AVX2 bytes in fixed point (`fixed_point`), and with AVX-512 up to 32 at a time (`wide`). What they cannot make goes
 * one by one through `sample_at`, and so does everything in the variant without vectors, with which tests compare the
 * others.
 */
#include "sampler.h"

#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#if defined(__AVX2__)
#include <immintrin.h>
#endif

#define JOINED_(a, b) a##_##b
#define JOINED(a, b) JOINED_(a, b)
#define THIS(name) JOINED(name, VARIANT)

#if defined(CAMTORCH_PLAIN)
#define VECTORS 0
#else
#define VECTORS 1
#endif
#define INLINE static inline __attribute__((always_inline))
#define NOT_INLINE static __attribute__((noinline))

enum { CHUNK = 256 };          /* pixels of a row whose positions are made at a time */
enum { MOST_INTERLEAVED = 4 }; /* channels */
enum { ROWS_AHEAD = 8 };       /* of the source */

/* What eight pixels are written to and read from */
typedef struct {
    const Job *job;
    const char *source; /* of the image */
    char *result;       /* of the first of the pixels */
    int64_t pixels;     /* how many there are */
} Span;

INLINE int64_t size_of(int type) {
    switch (type) {
    case UINT8: case BOOL: case BYTES1: return 1;
    case UINT16: case BYTES2: return 2;
    case FLOAT32: case BYTES4: return 4;
    default: return 8;
    }
}

/* -- one sample */

INLINE float load(const char *plane, int64_t at, int type) {
    switch (type) {
    case UINT8: return ((const uint8_t *)plane)[at];
    case BOOL: return ((const uint8_t *)plane)[at] != 0;
    case UINT16: return ((const uint16_t *)plane)[at];
    default: return ((const float *)plane)[at];
    }
}

INLINE void store(char *plane, int64_t at, float value, int type) {
    switch (type) {
    case UINT8: ((uint8_t *)plane)[at] = (uint8_t)rintf(value < 0 ? 0 : value > 255 ? 255 : value); break;
    case BOOL: ((uint8_t *)plane)[at] = value >= 0.5f; break;
    case UINT16: ((uint16_t *)plane)[at] = (uint16_t)rintf(value < 0 ? 0 : value > 65535 ? 65535 : value); break;
    default: ((float *)plane)[at] = value;
    }
}

INLINE void move(char *to, int64_t i, const char *from, int64_t j, int type) {
    switch (size_of(type)) {
    case 1: to[i] = from[j]; break;
    case 2: ((uint16_t *)to)[i] = ((const uint16_t *)from)[j]; break;
    case 4: ((uint32_t *)to)[i] = ((const uint32_t *)from)[j]; break;
    default: ((uint64_t *)to)[i] = ((const uint64_t *)from)[j];
    }
}

INLINE float greater(float a, float b) { return a > b ? a : b; }
INLINE float lesser(float a, float b) { return a < b ? a : b; }

/* What is not a number, as the reflection of infinity, is the first */
static float clamped(float x, float last) { return x > 0 ? x > last ? last : x : 0; }

static float reflected(float x, float side) {
    float extra, distance = fabsf(x + 0.5f);
    extra = fmodf(distance, side);
    if (fmodf(floorf(distance / side), 2) != 0) extra = side - extra;
    return clamped(extra - 0.5f, side - 1);
}

/* A coordinate as the padding reads it */
static float padded(float x, int64_t side, int padding) {
    if (padding == BORDER) return clamped(x, (float)(side - 1));
    return padding == REFLECTION ? reflected(x, (float)side) : x;
}

/* The cubic convolution of torch and OpenCV: Keys, 1981, with a = -3/4; for the pixels at -1, 0, 1, 2 */
INLINE void cubic_weights(float t, float *w) {
    const float s = 1 - t;
    w[0] = -0.75f * t * s * s;
    w[1] = (1.25f * t - 2.25f) * t * t + 1;
    w[2] = (1.25f * s - 2.25f) * s * s + 1;
    w[3] = -0.75f * s * t * t;
}

INLINE void linear_weights(float t, float *w) {
    w[1] = t;
    w[0] = 1 - t;
}

/* The modes that compute with pixels, in the order of their codes: how many pixels along an axis have a part in a sample,
   how far they lie from it at most, and their weights by how far the one before the sample is */
#define COMPUTING(ROW, type)                                                                                           \
    ROW(type, BILINEAR, 2, 1, linear_weights)                                                                          \
    ROW(type, BICUBIC, 4, 2, cubic_weights)

#define ONE(type, its, taps, reach, weights) +1
enum { COMPUTING_MODES = COMPUTING(ONE, ), MOST_TAPS = 4 };

#define FITS(type, its, taps, reach, weights) _Static_assert(taps <= MOST_TAPS, "MOST_TAPS is too small");
COMPUTING(FITS, )

/* Chosen by comparisons, which compilers resolve if they know the mode, and not looked up */
#define TAPS(type, its, taps, reach, weights) mode == its ? taps:
INLINE int taps_along(int mode) { return COMPUTING(TAPS, ) 1; }

#define REACH(type, its, taps, reach, weights) mode == its ? reach:
INLINE float reach_of(int mode) { return COMPUTING(REACH, ) 1; }

/* The taps of one axis: the pixels, -1 where there are none, and their weights */
INLINE void taps_of(float x, int64_t side, int mode, int padding, int64_t *at, float *weight) {
    int k;
    const int n = taps_along(mode);
    int64_t cell;
    if (n == 2) x = padded(x, side, padding); /* else each pixel is, as torch does */
    /* beyond, floats have no part of a pixel, nor images a pixel */
    if (x < -16777216.0f) x = -16777216.0f;
    if (x > 16777216.0f) x = 16777216.0f;
    cell = (int64_t)floorf(x);
#define WEIGH(type, its, taps, reach, weights)                                                                         \
    if (mode == its) weights(x - (float)cell, weight);
    COMPUTING(WEIGH, )
    cell -= n / 2 - 1;
    for (k = 0; k < n; k++) {
        int64_t i = cell + k;
        if (n > 2 && padding != ZEROS && (i < 0 || i >= side)) i = (int64_t)padded((float)i, side, padding);
        /* what lies beyond by rounding alone has no weight */
        if (padding != ZEROS && i >= side) i = side - 1;
        at[k] = i >= 0 && i < side ? i : -1;
    }
}

/* The taps of both axes */
typedef struct {
    int64_t columns[MOST_TAPS], rows[MOST_TAPS];
    float across[MOST_TAPS], down[MOST_TAPS];
} Taps;

/* u and v are not NaN */
NOT_INLINE Taps taps_at(const Job *job, float u, float v, int mode) {
    Taps taps;
    taps_of(u, job->source_width, mode, job->padding, taps.columns, taps.across);
    taps_of(v, job->source_height, mode, job->padding, taps.rows, taps.down);
    return taps;
}

/* One channel of one pixel, by the taps of weights above `lost`; `plane` is that of the channel */
INLINE float sum_of(const Job *job, const char *plane, const Taps *taps, float fill, int type, int mode, float lost_u,
                    float lost_v) {
    const int64_t *strides = job->source_strides, *columns = taps->columns, *rows = taps->rows;
    const float *across = taps->across, *down = taps->down;
    const int n = taps_along(mode);
    float sum = 0;
    int i, j;
    for (j = 0; j < n; j++)
        for (i = 0; i < n; i++)
            if (fabsf(down[j]) > lost_v && fabsf(across[i]) > lost_u)
                sum += down[j] * across[i] *
                       (rows[j] < 0 || columns[i] < 0
                            ? fill
                            : load(plane, rows[j] * strides[2] + columns[i] * strides[3], type));
    return sum;
}

INLINE float sample_at(const Job *job, const char *plane, const Taps *taps, float fill, int type, int mode) {
    const float sum = sum_of(job, plane, taps, fill, type, mode, -1, -1), rounding = 4 * 1.1920929e-7f;
    if (taps_along(mode) <= 2 || type != FLOAT32 || fabsf(sum) <= 3.4028235e38f) return sum;
    /* a pixel that is not finite has no part where its weight is but a rounding error */
    return sum_of(job, plane, taps, fill, type, mode, rounding * (float)job->source_width,
                  rounding * (float)job->source_height);
}

/* The pixel nearest to a position, or -1 */
INLINE int64_t nearest_of(float x, int64_t side, int padding) {
    float i = rintf(padded(x, side, padding));
    return i >= 0 && i <= (float)(side - 1) ? (int64_t)i : -1;
}

NOT_INLINE void show_nothing(const Span *span, int type) {
    const Job *job = span->job;
    const int64_t size = size_of(type), all = job->channels * size, *to = job->result_strides;
    const char *fill = (const char *)job->fill_elements;
    int64_t c, i;
    if (to[1] == 1 && to[3] == job->channels && memcmp(fill, fill + 1, (size_t)all - 1) == 0) {
        memset(span->result, fill[0], (size_t)(span->pixels * all)); /* mostly zeros */
        return;
    }
    for (c = 0; c < job->channels; c++, fill += size) {
        char *plane = span->result + c * to[1] * size;
        if (to[3] == 1 && memcmp(fill, fill + 1, (size_t)size - 1) == 0) memset(plane, fill[0], (size_t)(span->pixels * size));
        else
            for (i = 0; i < span->pixels; i++) move(plane, i * to[3], fill, 0, type);
    }
}

/* Pixels one by one; `done`: bits of those that are there */
NOT_INLINE void careful(const Span *span, const float *at_u, const float *at_v, int type, int mode, uint32_t done) {
    const Job *job = span->job;
    const int64_t bytes = size_of(type);
    int64_t i, c;
    for (i = 0; i < span->pixels; i++) {
        const float u = at_u[i], v = at_v[i];
        char *result = span->result + i * job->result_strides[3] * bytes;
        int shows = u == u && v == v;
        if (done >> i & 1) continue;
        if (shows && job->padding == ZEROS) {
            const float reach = reach_of(mode);
            shows = u > -reach && v > -reach && u < (float)job->source_width - 1 + reach &&
                    v < (float)job->source_height - 1 + reach;
        }
        if (shows && mode == NEAREST) {
            const int64_t x = nearest_of(u, job->source_width, job->padding);
            const int64_t y = nearest_of(v, job->source_height, job->padding);
            shows = x >= 0 && y >= 0;
            if (shows)
                for (c = 0; c < job->channels; c++)
                    move(result, c * job->result_strides[1], span->source,
                         c * job->source_strides[1] + y * job->source_strides[2] + x * job->source_strides[3], type);
        } else if (shows) {
            const Taps taps = taps_at(job, u, v, mode);
            for (c = 0; c < job->channels; c++) {
                const char *plane = span->source + c * job->source_strides[1] * bytes;
                const float value = sample_at(job, plane, &taps, job->fill[c], type, mode);
                store(result, c * job->result_strides[1], value, type);
            }
        }
        if (!shows)
            for (c = 0; c < job->channels; c++) move(result, c * job->result_strides[1], job->fill_elements, c, type);
    }
}

/* How pixels lie in memory, in source and result */
enum { PLANES, INTERLEAVED, SCATTERED };

#if VECTORS

/* Asks for what lies some rows below: rows are too short for a CPU to see by itself that they are read on and on.
 * An address alone, which need not be one of the image. */
INLINE void ask_below(const void *from, int64_t below) {
    __builtin_prefetch((const char *)((uintptr_t)from + (uintptr_t)(ROWS_AHEAD * below)));
}

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

/* Where eight pixels are read: from the corner (x, y) of a square of four pixels, at a part of its sides */
typedef struct {
    I8 x, y;
    V8 u, v; /* parts of the right column and of the lower row */
} Squares;

/* Whether all lie on the image, with `right` and `below` more pixels to the right and below */
INLINE int inside(const Job *job, V8 u, V8 v, float before, float beyond) {
    const V8 low = every8(before);
    const V8 right = every8((float)(job->source_width - 1) - beyond);
    const V8 below = every8((float)(job->source_height - 1) - beyond);
    return all8((u >= low) & (u <= right) & (v >= low) & (v <= below));
}

/* Whether no square begins in the last `beyond` columns or in the last row */
INLINE Squares squares_of(const Job *job, V8 u, V8 v, int32_t beyond) {
    Squares at;
    at.x = least8(whole8(u), every8i((int32_t)job->source_width - 1 - beyond));
    at.y = least8(whole8(v), every8i((int32_t)job->source_height - 2));
    at.u = u - float8(at.x);
    at.v = v - float8(at.y);
    return at;
}

/* -- eight pixels of one channel whose neighbours in a row are neighbours in memory */

INLINE void store_floats(char *to, V8 value, int64_t n) {
    if (n == STEP) memcpy(to, &value, sizeof value);
    else memcpy(to, &value, (size_t)n * sizeof(float));
}

INLINE void store_bytes(char *to, I8 value, int64_t n) {
    typedef int16_t W8 __attribute__((vector_size(16)));
    typedef uint8_t B8 __attribute__((vector_size(8)));
    const B8 bytes = __builtin_convertvector(__builtin_convertvector(value, W8), B8); /* in steps compilers know */
    if (n == STEP) memcpy(to, &bytes, sizeof bytes);
    else memcpy(to, &bytes, (size_t)n);
}

INLINE void store_words(char *to, I8 value, int64_t n) {
    typedef uint16_t W8 __attribute__((vector_size(16)));
    W8 words = __builtin_convertvector(value, W8);
    memcpy(to, &words, (size_t)n * 2);
}

/* Eight pixels of an image, of any rows */
INLINE V8 gathered(const char *from, const int64_t *at, int type) {
    V8 floats;
    I8 whole;
    int i;
    for (i = 0; i < STEP; i++) {
        if (type == FLOAT32) floats[i] = ((const float *)from)[at[i]];
        else if (type == UINT16) whole[i] = ((const uint16_t *)from)[at[i]];
        else whole[i] = ((const uint8_t *)from)[at[i]];
    }
    return type == FLOAT32 ? floats : float8(whole);
}

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

/* Eight pairs of neighbours in a row, between which `part` lies */
INLINE V8 between_pairs(const char *from, const int64_t *at, V8 part, int type) {
    V8 left, right;
#if defined(__AVX2__)
    if (type == FLOAT32) {
#define PAIR(i) from + 4 * at[i]
        const __m256 even = _mm256_castsi256_ps(quarters(PAIR(0), PAIR(1), PAIR(4), PAIR(5)));
        const __m256 odd = _mm256_castsi256_ps(quarters(PAIR(2), PAIR(3), PAIR(6), PAIR(7)));
#undef PAIR
        left = (V8)_mm256_shuffle_ps(even, odd, 0x88), right = (V8)_mm256_shuffle_ps(even, odd, 0xdd);
        return left * (1 - part) + right * part;
    }
#endif
    left = gathered(from, at, type), right = gathered(from + size_of(type), at, type);
    return left * (1 - part) + right * part;
}

/* True from one half on, as bytes */
INLINE I8 truth8(V8 value) { return -(value >= every8(0.5f)); }

/* Where eight pixels lie in memory, from the first one of the image on, in elements */
INLINE void offsets_of(const Job *job, I8 x, I8 y, int64_t *offsets) {
    const int64_t down = job->source_strides[2], across = job->source_strides[3];
    int i;
    if (down * job->source_height + across * job->source_width < INT32_MAX) {
        const I8 at = y * (int32_t)down + x * (int32_t)across;
        for (i = 0; i < STEP; i++) offsets[i] = at[i];
    } else {
        for (i = 0; i < STEP; i++) offsets[i] = y[i] * down + x[i] * across;
    }
}

INLINE void bilinear_planes(const Span *span, Squares at, int type) {
    const Job *job = span->job;
    const int64_t bytes = size_of(type), below = job->source_strides[2];
    const int64_t from = job->source_strides[1] * bytes, to = job->result_strides[1] * bytes;
    const char *plane = span->source;
    char *result = span->result;
    int64_t offsets[STEP], c;
    offsets_of(job, at.x, at.y, offsets);
    for (c = 0; c < job->channels; c++, plane += from, result += to) {
        const V8 above = between_pairs(plane, offsets, at.u, type);
        const V8 under = between_pairs(plane + below * bytes, offsets, at.u, type);
        const V8 value = above * (1 - at.v) + under * at.v;
        ask_below(plane + offsets[0] * bytes, below * bytes);
        if (type == FLOAT32) store_floats(result, value, span->pixels);
        else if (type == UINT16) store_words(result, rounded8(value), span->pixels);
        else store_bytes(result, type == BOOL ? truth8(value) : rounded8(value), span->pixels);
    }
}

/* -- eight pixels whose three or four channels are neighbours in memory, and then come those of the next pixel */

INLINE V4 channels4(const char *at, int type) {
    if (type == FLOAT32) return load4((const float *)at);
    if (type == UINT16) {
        typedef uint16_t W4 __attribute__((vector_size(8)));
        W4 words;
        memcpy(&words, at, sizeof words);
        return __builtin_convertvector(words, V4);
    } else {
#if defined(__AVX2__)
        int32_t packed;
        memcpy(&packed, at, sizeof packed);
        return (V4)_mm_cvtepi32_ps(_mm_cvtepu8_epi32(_mm_cvtsi32_si128(packed)));
#else
        uint8_t packed[4];
        memcpy(packed, at, sizeof packed);
        return (V4){packed[0], packed[1], packed[2], packed[3]};
#endif
    }
}

#if defined(__AVX512VBMI__) && defined(__AVX512VL__) && defined(__AVX512BW__) && defined(__AVX512DQ__)
#define WIDE 1
#else
#define WIDE 0
#endif

INLINE void bilinear_interleaved(const Span *span, Squares at, int type) {
    const Job *job = span->job;
    const int64_t bytes = size_of(type), channels = job->channels;
    const int64_t right = channels * bytes, below = job->source_strides[2] * bytes;
    float values[STEP * MOST_INTERLEAVED + 4];
    int64_t offsets[STEP], i, n = span->pixels * channels;
    offsets_of(job, at.x, at.y, offsets);
    ask_below(span->source + offsets[0] * bytes, below);
    ask_below(span->source + offsets[STEP - 1] * bytes, below);
    for (i = 0; i < STEP; i++) {
        const char *upper = span->source + offsets[i] * bytes, *lower = upper + below;
        const V4 u = every4(at.u[i]), v = every4(at.v[i]);
        const V4 above = channels4(upper, type) * (1 - u) + channels4(upper + right, type) * u;
        const V4 under = channels4(lower, type) * (1 - u) + channels4(lower + right, type) * u;
        const V4 value = above * (1 - v) + under * v;
        memcpy(values + i * channels, &value, sizeof value);
    }
    if (type == FLOAT32) {
        if (span->pixels == STEP && channels == 3) memcpy(span->result, values, 24 * sizeof(float));
        else memcpy(span->result, values, (size_t)n * sizeof(float));
    } else {
        for (i = 0; i < n; i += STEP) {
            const I8 whole = type == BOOL ? truth8(load8(values + i)) : rounded8(load8(values + i));
            const int64_t left = n - i < STEP ? n - i : STEP;
            if (type == UINT16) store_words(span->result + 2 * i, whole, left);
            else store_bytes(span->result + i, whole, left);
        }
    }
}

/* -- eight pixels of one channel, sixteen neighbours each */

INLINE void cubic_weights8(V8 t, V8 *w) {
    const V8 s = 1 - t;
    w[0] = -0.75f * t * s * s;
    w[1] = (1.25f * t - 2.25f) * t * t + 1;
    w[2] = (1.25f * s - 2.25f) * s * s + 1;
    w[3] = -0.75f * s * t * t;
}

/* Columns of a table of eight rows */
INLINE void transpose(const V4 *rows, V8 *columns) {
    int i, k;
    for (k = 0; k < 4; k++)
        for (i = 0; i < STEP; i++) columns[k][i] = rows[i][k];
}

INLINE void bicubic_planes(const Span *span, V8 u, V8 v, int type) {
    const Job *job = span->job;
    const int64_t bytes = size_of(type), below = job->source_strides[2] * bytes;
    const Squares at = squares_of(job, u, v, 1);
    V8 across[4], down[4];
    int64_t offsets[STEP], c;
    int i;
    offsets_of(job, at.x, at.y, offsets);
    cubic_weights8(at.u, across);
    cubic_weights8(at.v, down);
    for (c = 0; c < job->channels; c++) {
        const char *plane = span->source + c * job->source_strides[1] * bytes;
        char *result = span->result + c * job->result_strides[1] * bytes;
        V4 rows[STEP];
        V8 columns[4], value;
        ask_below(plane + offsets[0] * bytes, below);
        for (i = 0; i < STEP; i++) {
            const char *row = plane + (offsets[i] - 1) * bytes - below;
            rows[i] = channels4(row, type) * every4(down[0][i]) + channels4(row + below, type) * every4(down[1][i]) +
                      channels4(row + 2 * below, type) * every4(down[2][i]) +
                      channels4(row + 3 * below, type) * every4(down[3][i]);
        }
        transpose(rows, columns);
        value = columns[0] * across[0] + columns[1] * across[1] + columns[2] * across[2] + columns[3] * across[3];
        if (type == FLOAT32) {
            if (!all8((value >= every8(-3.4028235e38f)) & (value <= every8(3.4028235e38f))))
                for (i = 0; i < STEP; i++) {
                    const Taps taps = taps_at(job, u[i], v[i], BICUBIC);
                    value[i] = sample_at(job, plane, &taps, 0, FLOAT32, BICUBIC);
                }
            store_floats(result, value, span->pixels);
        } else if (type == BOOL) {
            store_bytes(result, truth8(value), span->pixels);
        } else {
            value = clamped8(value, type == UINT16 ? 65535 : 255);
            if (type == UINT16) store_words(result, rounded8(value), span->pixels);
            else store_bytes(result, rounded8(value), span->pixels);
        }
    }
}

INLINE void nearest8(const Span *span, V8 u, V8 v, int type) {
    const Job *job = span->job;
    const I8 x = rounded8(u), y = rounded8(v);
    int64_t offsets[STEP], c, i;
    offsets_of(job, x, y, offsets);
    for (c = 0; c < job->channels; c++) {
        const char *plane = span->source + c * job->source_strides[1] * size_of(type);
        char *result = span->result + c * job->result_strides[1] * size_of(type);
        ask_below(plane + offsets[0] * size_of(type), job->source_strides[2] * size_of(type));
        if (span->pixels == STEP && job->result_strides[3] == 1)
            for (i = 0; i < STEP; i++) move(result, i, plane, offsets[i], type);
        else
            for (i = 0; i < span->pixels; i++) move(result, i * job->result_strides[3], plane, offsets[i], type);
    }
}

/* Whether eight pixels lie beyond what zeros reach, or have no position */
INLINE int shows_nothing(const Job *job, V8 u, V8 v, int mode) {
    const float reach = job->padding != ZEROS ? INFINITY : reach_of(mode);
    const V8 low = every8(-reach);
    const V8 right = every8((float)(job->source_width - 1) + reach);
    const V8 below = every8((float)(job->source_height - 1) + reach);
    return all8(~((u >= low) & (u <= right) & (v >= low) & (v <= below)));
}

INLINE void eight(const Span *span, const float *at_u, const float *at_v, int type, int mode, int layout) {
    const Job *job = span->job;
    const V8 u = load8(at_u), v = load8(at_v);
    int done = 0;
    if (mode == NEAREST) {
        if (inside(job, u, v, 0, 0)) {
            nearest8(span, u, v, type);
            return;
        }
    } else if (mode == BILINEAR && layout == PLANES) {
        if (job->source_width > 1 && job->source_height > 1 && inside(job, u, v, 0, 0)) {
            bilinear_planes(span, squares_of(job, u, v, 1), type);
            return;
        }
    } else if (mode == BILINEAR && layout == INTERLEAVED) {
        /* two pixels are read as eight elements, where six are theirs */
        if (job->source_width > 2 && job->source_height > 1 && inside(job, u, v, 0, 1)) {
            bilinear_interleaved(span, squares_of(job, u, v, 2), type);
            return;
        }
    } else if (mode == BICUBIC && layout == PLANES) {
        if (job->source_width > 3 && job->source_height > 3 && inside(job, u, v, 1, 2)) {
            bicubic_planes(span, u, v, type);
            return;
        }
    }
    if (shows_nothing(job, u, v, mode)) {
        show_nothing(span, type);
        return;
    }
    const int several = job->source_width > 2 && job->source_height > 1;
    if (job->padding == ZEROS && mode == BILINEAR && layout != SCATTERED && several) {
        /* those on the image at once, with the corner in the place of the others */
        const I8 in = (u >= every8(0)) & (u <= every8((float)(job->source_width - 2))) & (v >= every8(0)) &
                      (v <= every8((float)(job->source_height - 1)));
        if ((done = lanes8(in))) {
            const V8 on_u = (V8)((I8)u & in), on_v = (V8)((I8)v & in);
            if (layout == PLANES) bilinear_planes(span, squares_of(job, on_u, on_v, 1), type);
            else bilinear_interleaved(span, squares_of(job, on_u, on_v, 2), type);
        }
    }
    careful(span, at_u, at_v, type, mode, (uint32_t)done);
}

#else
#define WIDE 0

INLINE void eight(const Span *span, const float *at_u, const float *at_v, int type, int mode, int layout) {
    (void)layout;
    careful(span, at_u, at_v, type, mode, 0);
}

#endif

/* -- positions */

/* Weights of the nodes at -1, 0, 1, 2 in the cubic through them, at 0, 1/8, ..., 7/8 */
#define T(i) ((i) / 8.0f)
#define ROW0(i) (-T(i) * (T(i) - 1) * (T(i) - 2) / 6)
#define ROW1(i) ((T(i) + 1) * (T(i) - 1) * (T(i) - 2) / 2)
#define ROW2(i) (-(T(i) + 1) * T(i) * (T(i) - 2) / 2)
#define ROW3(i) ((T(i) + 1) * T(i) * (T(i) - 1) / 6)
#define EIGHT(f) {f(0), f(1), f(2), f(3), f(4), f(5), f(6), f(7)}
static const float WEIGHTS[4][STEP] = {EIGHT(ROW0), EIGHT(ROW1), EIGHT(ROW2), EIGHT(ROW3)};

/* Of pixels of a row, in pixels of the source; NaN where there is none */
typedef struct {
    _Alignas(64) float u[CHUNK + STEP];
    float v[CHUNK + STEP];
} Chunk;

/* Lines of pixels between the nodes of a row each, the four that the rows of a cell lie between: that of the i-th row of
 * nodes at i % 4. In pixels of the source. */
typedef struct {
    _Alignas(64) float u[4][CHUNK];
    float v[4][CHUNK];
    int cubic; /* whether all cells are */
} Lines;

/* The cubics along a row of nodes, the first of which lies before that of the first pixel */
NOT_INLINE void lay_line(const float *nodes, int64_t cells, float side, float *__restrict line) {
    const float half = side / 2, middle = (side - 1) / 2;
    int64_t j;
    for (j = 0; j < cells; j++, nodes++, line += STEP) {
        const float a = nodes[0] * half, b = nodes[1] * half, c = nodes[2] * half, d = nodes[3] * half;
#if VECTORS
        const V8 made = load8(WEIGHTS[0]) * a + load8(WEIGHTS[1]) * b + load8(WEIGHTS[2]) * c + load8(WEIGHTS[3]) * d +
                        middle;
        memcpy(line, &made, sizeof made);
#else
        int k;
        for (k = 0; k < STEP; k++)
            line[k] = WEIGHTS[0][k] * a + WEIGHTS[1][k] * b + WEIGHTS[2][k] * c + WEIGHTS[3][k] * d + middle;
#endif
    }
}

/* Those between four lines, at `part` / 8 from the second to the third one */
NOT_INLINE void between_lines(const float (*lines)[CHUNK], int64_t row, int part, int64_t n, float *__restrict to) {
    const float w0 = WEIGHTS[0][part], w1 = WEIGHTS[1][part], w2 = WEIGHTS[2][part], w3 = WEIGHTS[3][part];
    const float *a = lines[row % 4], *b = lines[(row + 1) % 4], *c = lines[(row + 2) % 4], *d = lines[(row + 3) % 4];
    int64_t k;
    for (k = 0; k < n; k++) to[k] = a[k] * w0 + b[k] * w1 + c[k] * w2 + d[k] * w3;
}

/* From a lattice, of whole cells; a row of a tile after the other, from its `first` one on */
static void lattice_positions(const Job *job, int64_t b, int64_t y, int64_t x, int64_t n, int64_t first, Lines *lines,
                              Chunk *at) {
    const int64_t i = y / STEP, column = x / STEP, width = job->columns + 5, count = (n + STEP - 1) / STEP;
    const int part = (int)(y % STEP);
    const float *nodes = job->nodes + b * job->node_strides[0] + column + 1;
    const int32_t *cells = job->cells + b * job->cell_stride + i * job->columns + column;
    int64_t j;
    int k;
    if (y == first || part == 0) {
        for (j = y == first ? i + 1 : i + 4; j < i + 5; j++) {
            lay_line(nodes + j * width, count, (float)job->source_width, lines->u[j % 4]);
            lay_line(nodes + job->node_strides[1] + j * width, count, (float)job->source_height, lines->v[j % 4]);
        }
        lines->cubic = 1;
        for (j = 0; j < count; j++) lines->cubic &= cells[j] == CELL_CUBIC;
    }
    between_lines(lines->u, i + 1, part, count * STEP, at->u);
    between_lines(lines->v, i + 1, part, count * STEP, at->v);
    for (j = 0; j < count && !lines->cubic; j++) {
        float *u = at->u + j * STEP, *v = at->v + j * STEP;
        if (cells[j] == CELL_EMPTY) {
            for (k = 0; k < STEP; k++) u[k] = v[k] = NAN;
        } else if (cells[j] != CELL_CUBIC) {
            const float *exact = job->exact + ((int64_t)cells[j] * STEP + part) * STEP;
            for (k = 0; k < STEP; k++) {
                u[k] = ((exact[k] + 1) * (float)job->source_width - 1) / 2;
                v[k] = ((exact[k + job->exact_stride] + 1) * (float)job->source_height - 1) / 2;
            }
        }
    }
}

/* From a grid; those behind the last pixel of a row are that of the last one */
static void grid_positions(const Job *job, int64_t b, int64_t y, int64_t x, int64_t n, Chunk *at) {
    const int64_t across = job->grid_strides[2], to_v = job->grid_strides[3], filled = (n + STEP - 1) / STEP * STEP;
    const int64_t start = b * job->grid_strides[0] + y * job->grid_strides[1] + x * across;
    const float half_u = (float)job->source_width / 2, half_v = (float)job->source_height / 2;
    const float *grid = (const float *)job->grid + start;
    const double *wide = (const double *)job->grid + start;
    int64_t k;
    if (job->grid_is_double)
        for (k = 0; k < n; k++) at->u[k] = (float)wide[k * across], at->v[k] = (float)wide[k * across + to_v];
    else if (across == 1)
        for (k = 0; k < n; k++) at->u[k] = grid[k], at->v[k] = grid[k + to_v];
    else if (across == 2 && to_v == 1)
        for (k = 0; k < n; k++) at->u[k] = grid[2 * k], at->v[k] = grid[2 * k + 1];
    else
        for (k = 0; k < n; k++) at->u[k] = grid[k * across], at->v[k] = grid[k * across + to_v];
    for (k = n; k < filled; k++) at->u[k] = at->u[n - 1], at->v[k] = at->v[n - 1];
    /* as torch's grid_sample does: on noise every rounding shows */
    for (k = 0; k < filled; k++) {
        at->u[k] = (at->u[k] + 1) * half_u - 0.5f;
        at->v[k] = (at->v[k] + 1) * half_v - 0.5f;
    }
    if (job->mapped) {
        const uint8_t *mapped = job->mapped + b * job->mapped_stride + y * job->width + x;
        for (k = 0; k < n; k++)
            if (!mapped[k]) at->u[k] = NAN;
    }
}

/* Pixels i ... n - 1 of a row; `first`: where that at 0 is written */
INLINE void eights(Span *span, char *first, const Chunk *at, int64_t i, int64_t n, int type, int mode, int layout) {
    const int64_t step = span->job->result_strides[3] * size_of(type);
    for (; i < n; i += STEP) {
        span->result = first + i * step, span->pixels = n - i < STEP ? n - i : STEP;
        eight(span, at->u + i, at->v + i, type, mode, layout);
    }
}

/* -- bytes by fixed point: positions in 2^-16 of a pixel, results in 2^-8 of a grey level */

#if defined(__AVX2__)

/* Where images lie, of the kinds that are known here, strides in elements */
typedef struct {
    const char *source;
    int64_t channels, from_plane, below, to_plane, width, height;
} Image;

/* Keeps a constant in a register: compilers make it again for each use */
INLINE __m256i kept(__m256i constant) {
    __asm__("" : "+x"(constant));
    return constant;
}

typedef struct {
    __m256i sum, difference, half;
} Weights;

INLINE Weights kept_weights(void) {
    return (Weights){kept(_mm256_set1_epi16(0x4040)), kept(_mm256_set1_epi16(0x40c0)), kept(_mm256_set1_epi16(128))};
}

/* Interpolates between the two bytes of each word, at 2 t - 1 in 2^-15; the result in 2^-7 */
INLINE __m256i across16(const Weights *by, __m256i pairs, __m256i t) {
    const __m256i difference = _mm256_maddubs_epi16(pairs, by->difference);
    return _mm256_add_epi16(_mm256_maddubs_epi16(pairs, by->sum), _mm256_mulhrs_epi16(difference, t));
}

/* Interpolates between two such results; the upper bytes of words are the result */
INLINE __m256i down16(const Weights *by, __m256i a, __m256i b, __m256i t) {
    const __m256i sum = _mm256_add_epi16(_mm256_add_epi16(a, b), by->half);
    return _mm256_add_epi16(sum, _mm256_mulhrs_epi16(_mm256_sub_epi16(b, a), t));
}

/* Stores eight pixels of three or four channels: the upper bytes of words, of pixels 0, 1, 4, 5 in the first register, and of
 * the others in the second one */
INLINE void store_eight(char *result, __m256i first, __m256i second, const int pixel) {
    const __m256i bytes = _mm256_packus_epi16(_mm256_srli_epi16(first, 8), _mm256_srli_epi16(second, 8));
    if (pixel == 4) {
        _mm256_storeu_si256((__m256i *)result, bytes);
        return;
    }
    const __m256i three = _mm256_setr_epi64x(0x0908060504020100, 0x0e0d0c0a, 0x0908060504020100, 0x0e0d0c0a);
    const __m256i dense = _mm256_shuffle_epi8(bytes, three);
    const __m256i ordered = _mm256_permutevar8x32_epi32(dense, _mm256_setr_epi32(0, 1, 2, 4, 5, 6, 7, 7));
    _mm_storeu_si128((__m128i *)result, _mm256_castsi256_si128(ordered));
    _mm_storel_epi64((__m128i *)(result + 16), _mm256_extracti128_si256(ordered, 1));
}

/* Windows of sixteen columns and five rows, in which the neighbours of eight pixels each are expected */
typedef struct {
    _Alignas(32) float u[CHUNK / STEP + STEP], v[CHUNK / STEP + STEP]; /* 128 less their first column and row */
    int32_t at[CHUNK / STEP + STEP];                                   /* of their first element */
} Windows;

enum { FIVE_ROWS = 5 };
#define EIGHTS 0x0808080808080808

/* The lesser of the first positions of eight pixels and of the next eight, less what others may lie lower; from 0 to
 * `last`, also if it is NaN */
INLINE I8 begins(const float *x, int64_t last) {
#define TWO(i) _mm_unpacklo_ps(_mm_loadu_ps(x + STEP * (i)), _mm_loadu_ps(x + STEP * ((i) + 1)))
    const __m256 first = _mm256_set_m128(_mm_movelh_ps(TWO(4), TWO(6)), _mm_movelh_ps(TWO(0), TWO(2)));
#undef TWO
    const __m256 turned = _mm256_permutevar8x32_ps(first, _mm256_setr_epi32(1, 2, 3, 4, 5, 6, 7, 0));
    const __m256 next = _mm256_blend_ps(turned, _mm256_broadcast_ss(x + STEP * STEP), 0x80);
    const __m256 least = _mm256_sub_ps(_mm256_min_ps(next, first), _mm256_set1_ps(1 / 64.0f));
    return whole8((V8)_mm256_max_ps(_mm256_min_ps(least, _mm256_set1_ps((float)last)), _mm256_setzero_ps()));
}

NOT_INLINE void windows_of(const Image *image, const Chunk *at, int64_t i, int64_t n, Windows *windows) {
    int64_t j;
    for (j = i / STEP / STEP * STEP; j < n / STEP; j += STEP) {
        const I8 x = begins(at->u + STEP * j, image->width - 16);
        const I8 y = begins(at->v + STEP * j, image->height - FIVE_ROWS);
        const I8 begin = y * (int32_t)image->below + x;
        const V8 from_u = 128 - float8(x), from_v = 128 - float8(y);
        memcpy(windows->u + j, &from_u, sizeof from_u), memcpy(windows->v + j, &from_v, sizeof from_v);
        memcpy(windows->at + j, &begin, sizeof begin);
    }
}

/* Positions 0 ... 3 and 8 ... 11 */
INLINE __m256 fours(const float *x) {
    return _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(x)), _mm_loadu_ps(x + 8), 1);
}

/* The upper 16 bits of numbers of both in turn: of such fours, pixels 0, 4, 1, 5, 2, 6, 3, 7 in each half */
INLINE __m256i uppers(__m256i a, __m256i b) { return _mm256_blend_epi16(_mm256_srli_epi32(a, 16), b, 0xaa); }

/* The lower 16 bits, which are parts t of a pixel, as 2 t - 1 in 2^-15 */
INLINE __m256i lowers(__m256i a, __m256i b) {
    return _mm256_xor_si256(_mm256_blend_epi16(a, _mm256_slli_epi32(b, 16), 0xaa), _mm256_set1_epi16((short)0x8000));
}

/* The lower byte of each word twice */
INLINE __m256i doubled(__m256i words) {
    const int64_t low = 0x0606040402020000, high = 0x0e0e0c0c0a0a0808;
    return _mm256_shuffle_epi8(words, _mm256_setr_epi64x(low, high, low, high));
}

/* Stores sixteen pixels in that order: the upper bytes of words, or of the nearest pixels the lower ones */
INLINE void store_sixteen(char *result, __m256i words, const int mode) {
    const int64_t order = mode == NEAREST ? 0x0e0a06020c080400 : 0x0f0b07030d090501;
    const __m256i halves = _mm256_shuffle_epi8(words, _mm256_setr_epi64x(order, -1, order, -1));
    const __m256i bytes = _mm256_permute4x64_epi64(halves, 0x08);
    _mm_storeu_si128((__m128i *)result, _mm256_castsi256_si128(bytes));
}

INLINE int16_t two_bytes(const char *from) {
    int16_t bytes;
    memcpy(&bytes, from, sizeof bytes);
    return bytes;
}

/* Pairs of bytes at four places, and at those eight later */
INLINE __m128i eight_pairs(const char *from, const int32_t *at) {
#define PAIR(i) two_bytes(from + at[i])
    return _mm_setr_epi16(PAIR(0), PAIR(1), PAIR(2), PAIR(3), PAIR(8), PAIR(9), PAIR(10), PAIR(11));
#undef PAIR
}

/* Sixteen bytes of each of two places */
INLINE __m256i two_rows(const char *a, const char *b) {
    return _mm256_inserti128_si256(_mm256_castsi128_si256(_mm_loadu_si128((const __m128i *)a)),
                                   _mm_loadu_si128((const __m128i *)b), 1);
}

/* Sixteen pixels: which bytes of a row they read, the row of their window as 0x4300 and more, and parts of a pixel */
typedef struct {
    __m256i pick, row, part_u, part_v;
    const char *first, *second; /* where the windows of the halves begin */
} Sixteen;

/* Makes them in each plane, from so many rows of their windows */
INLINE void rows_of_planes(const Image *image, char *result, const Sixteen *at, const Weights *by, const int rows,
                           const int mode) {
    const char *first = at->first, *second = at->second;
    __m256i below[FIVE_ROWS];
    int64_t c;
    int k;
    for (k = 0; k < rows - 1; k++) below[k] = _mm256_cmpgt_epi16(at->row, _mm256_set1_epi16((short)(0x4300 + k)));
    for (c = 0; c < image->channels; c++) {
        __m256i made[FIVE_ROWS], upper, lower, value;
        ask_below(first, image->below);
        for (k = 0; k < rows; k++)
            made[k] = _mm256_shuffle_epi8(two_rows(first + k * image->below, second + k * image->below), at->pick);
        upper = made[0], lower = made[1];
        if (mode == NEAREST) {
            for (k = 1; k < rows; k++) upper = _mm256_blendv_epi8(upper, made[k], below[k - 1]);
            value = upper;
        } else {
            for (k = 0; k < rows - 2; k++) {
                upper = _mm256_blendv_epi8(upper, made[k + 1], below[k]);
                lower = _mm256_blendv_epi8(lower, made[k + 2], below[k]);
            }
            value = down16(by, across16(by, upper, at->part_u), across16(by, lower, at->part_u), at->part_v);
        }
        store_sixteen(result, value, mode);
        first += image->from_plane, second += image->from_plane, result += image->to_plane;
    }
}

/* Makes pixels i ... n - 1 of planes, sixteen at a time, up to the first that their windows do not hold; returns where */
INLINE int64_t sixteens(const Image *image, const Windows *windows, char *first, const Chunk *chunk, int64_t i,
                        int64_t n, const int mode) {
    const __m256i halves = kept(_mm256_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1)), begin = kept(_mm256_set1_epi16(0x4300));
    const __m256i nothing = _mm256_set1_epi16((short)0x8000), right = _mm256_set1_epi16(0x0100);
    const int beyond = mode == NEAREST ? 1 : 2;
    const __m256i columns = kept(_mm256_set1_epi16((short)(16 - beyond)));
    const __m256i three = kept(_mm256_set1_epi16((short)(3 - beyond)));
    const __m256i five = _mm256_set1_epi16((short)(FIVE_ROWS - beyond));
    const Weights weights = kept_weights();
    for (; n - i >= 16; i += 16) {
        const float *u = chunk->u + i, *v = chunk->v + i;
        Sixteen at;
#define NUMBERS(x, from)                                                                                               \
    _mm256_castps_si256(_mm256_add_ps(mode == NEAREST ? _mm256_round_ps(fours(x), 0) : fours(x),                       \
                                      _mm256_permutevar8x32_ps(_mm256_loadu_ps(from + i / STEP), halves)))
        const __m256i u0 = NUMBERS(u, windows->u), u1 = NUMBERS(u + 4, windows->u);
        const __m256i v0 = NUMBERS(v, windows->v), v1 = NUMBERS(v + 4, windows->v);
#undef NUMBERS
        const __m256i column = uppers(u0, u1);
        at.row = uppers(v0, v1), at.part_u = lowers(u0, u1), at.part_v = lowers(v0, v1);
        at.pick = mode == NEAREST ? _mm256_or_si256(doubled(column), nothing) : _mm256_add_epi8(doubled(column), right);
        at.first = image->source + windows->at[i / STEP], at.second = image->source + windows->at[i / STEP + 1];
        const __m256i far = _mm256_subs_epu16(_mm256_sub_epi16(column, begin), columns);
        const __m256i row = _mm256_sub_epi16(at.row, begin);
        const __m256i low = _mm256_or_si256(far, _mm256_subs_epu16(row, three));
        if (_mm256_testz_si256(low, low)) {
            rows_of_planes(image, first + i, &at, &weights, 3, mode);
        } else {
            const __m256i lower = _mm256_or_si256(far, _mm256_subs_epu16(row, five));
            if (!_mm256_testz_si256(lower, lower)) break;
            rows_of_planes(image, first + i, &at, &weights, FIVE_ROWS, mode);
        }
    }
    return i;
}

NOT_INLINE int64_t sixteens_of(const Image *image, const Windows *windows, char *first, const Chunk *at, int64_t i,
                               int64_t n, int mode) {
    if (mode == NEAREST) return sixteens(image, windows, first, at, i, n, NEAREST);
    return sixteens(image, windows, first, at, i, n, BILINEAR);
}

/* -- eight pixels of three or four channels, one by one: a pixel and the next one of a row are six or eight bytes */

/* Repeats a byte of the 32 bits of a pixel, or the word that begins with it, for all that is made of the pixel: of pixels
 * 0, 1, 4, 5 for the first half of the result, of the others for the second one */
INLINE __m256i spread(__m256i pixels, const int half, const int byte, const int words) {
    const int64_t each = 0x0101010101010101, first = (8 * half + byte) * each + (words ? 0x0100010001000100 : 0);
    return _mm256_shuffle_epi8(pixels, _mm256_setr_epi64x(first, first + 4 * each, first, first + 4 * each));
}

/* Pairs the channels of a pixel with those of the next one */
INLINE __m256i neighbours(const int pixel) {
    return _mm256_set1_epi64x(pixel == 4 ? 0x0703060205010400 : 0x0000050204010300);
}

INLINE __m256i in_fixed_point(__m256 x) { return _mm256_cvtps_epi32(_mm256_mul_ps(x, _mm256_set1_ps(65536))); }

/* Makes pixels i ... n - 1, eight at a time, up to the first of which some lie off the image; returns where */
INLINE int64_t interleaved(const Image *image, char *first, const Chunk *at, int64_t i, int64_t n, const int pixel) {
    /* eight bytes hold a part of a third pixel of three channels */
    const uint32_t right = (uint32_t)(image->width - (pixel == 3 ? 3 : 2)), bottom = (uint32_t)(image->height - 2);
    const __m256i last = kept(_mm256_set1_epi32((int32_t)(bottom << 16 | right)));
    const __m256i steps = kept(_mm256_set1_epi32((int32_t)(image->below << 16 | pixel)));
    const __m256i pick = kept(_mm256_add_epi8(neighbours(pixel), _mm256_setr_epi64x(0, EIGHTS, 0, EIGHTS)));
    const Weights weights = kept_weights();
    const char *upper = image->source, *lower = upper + image->below;
    for (; n - i >= STEP; i += STEP) {
        const __m256i x = in_fixed_point(_mm256_loadu_ps(at->u + i)), y = in_fixed_point(_mm256_loadu_ps(at->v + i));
        const __m256i square = uppers(x, y), part = lowers(x, y);
        if (_mm256_movemask_epi8(_mm256_cmpeq_epi16(_mm256_min_epu16(square, last), square)) != -1) break;
        __m256i made[2];
        _Alignas(32) int32_t o[STEP];
        int k;
        _mm256_store_si256((__m256i *)o, _mm256_madd_epi16(square, steps));
        ask_below(upper + o[0], image->below), ask_below(upper + o[STEP - 1], image->below);
        for (k = 0; k < 2; k++) {
            const int64_t a = o[2 * k], b = o[2 * k + 1], c = o[2 * k + 4], d = o[2 * k + 5];
            const __m256i above = _mm256_shuffle_epi8(quarters(upper + a, upper + b, upper + c, upper + d), pick);
            const __m256i under = _mm256_shuffle_epi8(quarters(lower + a, lower + b, lower + c, lower + d), pick);
            const __m256i t_u = spread(part, k, 0, 1), t_v = spread(part, k, 2, 1);
            made[k] = down16(&weights, across16(&weights, above, t_u), across16(&weights, under, t_u), t_v);
        }
        store_eight(first + i * pixel, made[0], made[1], pixel);
    }
    return i;
}

NOT_INLINE int64_t eights_of(const Image *image, char *first, const Chunk *at, int64_t i, int64_t n, int pixel) {
    return pixel == 3 ? interleaved(image, first, at, i, n, 3) : interleaved(image, first, at, i, n, 4);
}

/* Positions in fixed point, at most at the pixels next to the image, which are `fill`; NaN is one of them */
INLINE __m256i held(const Job *job, __m256 x, int64_t side) {
    const float beyond = job->padding == ZEROS;
    const __m256 low = _mm256_set1_ps(-beyond), high = _mm256_set1_ps((float)(side - 1) + beyond);
    const __m256 on = _mm256_min_ps(_mm256_max_ps(x, low), high), is_nan = _mm256_cmp_ps(x, x, _CMP_UNORD_Q);
    return in_fixed_point(_mm256_blendv_ps(on, _mm256_set1_ps(-1), is_nan));
}

/* Makes sixteen pixels of planes that lie anywhere: what is off the image is `fill` */
INLINE void any_sixteen(const Job *job, const Image *image, char *result, const float *u, const float *v) {
    const __m256i right = _mm256_set1_epi16((short)(image->width - 2)), zero = _mm256_setzero_si256();
    const __m256i bottom = _mm256_set1_epi16((short)(image->height - 1)), one = _mm256_set1_epi16(1);
    const __m256i steps = _mm256_set1_epi32((int32_t)(image->below << 16 | 1));
    const __m256i u0 = held(job, fours(u), image->width), u1 = held(job, fours(u + 4), image->width);
    const __m256i v0 = held(job, fours(v), image->height), v1 = held(job, fours(v + 4), image->height);
    const __m256i x = uppers(u0, u1), y = uppers(v0, v1), next = _mm256_add_epi16(y, one);
    const __m256i begin = _mm256_max_epi16(_mm256_min_epi16(x, right), zero);
    /* where its neighbours lie in the two bytes that are read, and which of them do */
    const __m256i off = doubled(_mm256_sub_epi16(x, begin)), where = _mm256_add_epi8(off, _mm256_set1_epi16(0x0100));
    const __m256i there = _mm256_cmpeq_epi8(_mm256_min_epu8(where, _mm256_set1_epi8(1)), where);
    const int64_t low = 0x0706050403020100, high = low + EIGHTS;
    const __m256i pick = _mm256_add_epi8(off, _mm256_setr_epi64x(low, high, low, high));
    const Weights weights = kept_weights();
    const char *plane = image->source;
    __m256i shown[2];
    _Alignas(32) int32_t o[2][16];
    int64_t c;
    int k;
    for (k = 0; k < 2; k++) {
        const __m256i wanted = k ? next : y, row = _mm256_max_epi16(_mm256_min_epi16(wanted, bottom), zero);
        shown[k] = _mm256_and_si256(there, _mm256_cmpeq_epi16(row, wanted));
        _mm256_store_si256((__m256i *)o[k], _mm256_madd_epi16(_mm256_unpacklo_epi16(begin, row), steps));
        _mm256_store_si256((__m256i *)o[k] + 1, _mm256_madd_epi16(_mm256_unpackhi_epi16(begin, row), steps));
    }
    for (c = 0; c < image->channels; c++) {
        const __m256i fill = _mm256_set1_epi8(((const char *)job->fill_elements)[c]);
        __m256i rows[2];
        for (k = 0; k < 2; k++) {
            const __m256i read = _mm256_set_m128i(eight_pairs(plane, o[k] + 4), eight_pairs(plane, o[k]));
            rows[k] = _mm256_blendv_epi8(fill, _mm256_shuffle_epi8(read, pick), shown[k]);
            rows[k] = across16(&weights, rows[k], lowers(u0, u1));
        }
        store_sixteen(result, down16(&weights, rows[0], rows[1], lowers(v0, v1)), BILINEAR);
        plane += image->from_plane, result += image->to_plane;
    }
}

/* Makes eight pixels of three or four channels likewise */
INLINE void any_eight(const Job *job, const Image *image, char *result, const float *u, const float *v, const int pixel) {
    const __m256i zero = _mm256_setzero_si256(), one = _mm256_set1_epi32(1), seven = _mm256_set1_epi8(7);
    const __m256i at_u = held(job, _mm256_loadu_ps(u), image->width), x = _mm256_srai_epi32(at_u, 16);
    const __m256i at_v = held(job, _mm256_loadu_ps(v), image->height), y = _mm256_srai_epi32(at_v, 16);
    const __m256i bottom = _mm256_set1_epi32((int32_t)image->height - 1);
    const __m256i below = _mm256_set1_epi32((int32_t)image->below);
    const __m256i byte = _mm256_mullo_epi32(x, _mm256_set1_epi32(pixel));
    const __m256i last = _mm256_set1_epi32((int32_t)image->width * pixel - 8), part = lowers(at_u, at_v);
    const __m256i begin = _mm256_max_epi32(_mm256_min_epi32(byte, last), zero);
    /* of each pixel, a byte each: where it lies in the eight bytes that are read, and which of its rows are there */
    __m256i marks = _mm256_and_si256(_mm256_sub_epi32(byte, begin), _mm256_set1_epi32(0xff)), made[2];
    const Weights weights = kept_weights();
    const uint8_t *fill = (const uint8_t *)job->fill_elements;
    uint64_t filled = 0;
    _Alignas(32) int32_t o[2][STEP];
    int k, row;
    for (k = 0; k < pixel; k++) filled |= (uint64_t)(fill[k] * 0x0101u) << 16 * k;
    const __m256i fills = _mm256_set1_epi64x((int64_t)filled);
    for (k = 0; k < 2; k++) {
        const __m256i wanted = k ? _mm256_add_epi32(y, one) : y, mark = _mm256_set1_epi32(0xff00 << 8 * k);
        const __m256i there = _mm256_max_epi32(_mm256_min_epi32(wanted, bottom), zero);
        _mm256_store_si256((__m256i *)o[k], _mm256_add_epi32(_mm256_mullo_epi32(there, below), begin));
        marks = _mm256_or_si256(marks, _mm256_and_si256(_mm256_cmpeq_epi32(there, wanted), mark));
    }
    for (k = 0; k < 2; k++) {
        const __m256i where = _mm256_add_epi8(neighbours(pixel), spread(marks, k, 0, 0));
        const __m256i there = _mm256_cmpeq_epi8(_mm256_min_epu8(where, seven), where), t = spread(part, k, 0, 1);
        const __m256i pick = _mm256_add_epi8(where, _mm256_setr_epi64x(0, EIGHTS, 0, EIGHTS));
        __m256i rows[2];
        for (row = 0; row < 2; row++) {
            const int32_t *i = o[row] + 2 * k;
            const char *from = image->source;
            const __m256i all = quarters(from + i[0], from + i[1], from + i[4], from + i[5]);
            const __m256i read = _mm256_shuffle_epi8(all, pick);
            const __m256i shown = _mm256_and_si256(there, spread(marks, k, row + 1, 0));
            rows[row] = across16(&weights, _mm256_blendv_epi8(fills, read, shown), t);
        }
        made[k] = down16(&weights, rows[0], rows[1], spread(part, k, 2, 1));
    }
    store_eight(result, made[0], made[1], pixel);
}

NOT_INLINE void anywhere(const Job *job, const Image *image, char *result, const float *u, const float *v, int pixel) {
    if (pixel == 1) any_sixteen(job, image, result, u, v);
    else if (pixel == 3) any_eight(job, image, result, u, v, 3);
    else any_eight(job, image, result, u, v, 4);
}

/* Whether 16 bits hold all places of an image, and its rows at least eight bytes */
INLINE int is_small(const Image *image) {
    const int has_small_steps = image->below >= 0 && image->below < 32768;
    return has_small_steps && image->width >= 8 && image->width < 32767 && image->height < 32767;
}

/* Whether what lies off an image, and is blended in, is a byte */
INLINE int fills_bytes(const Job *job, const Image *image) {
    int fits = 1;
    int64_t c;
    for (c = 0; c < image->channels && job->padding == ZEROS; c++)
        fits &= job->fill[c] == (float)((const uint8_t *)job->fill_elements)[c];
    return fits;
}

/* Makes pixels i ... n - 1 that lie anywhere: whole sixteens of planes, eights of channels side by side */
INLINE void off_windows(Span *span, const Image *image, char *first, const Chunk *at, int64_t i, int64_t n, int mode,
                        int pixel) {
    const int fits = mode == BILINEAR && is_small(image) && fills_bytes(span->job, image);
    for (; i < n && fits; i += pixel == 1 ? 16 : STEP)
        anywhere(span->job, image, first + i * pixel, at->u + i, at->v + i, pixel);
    if (mode == NEAREST) eights(span, first, at, i, n, BYTES1, NEAREST, SCATTERED);
    else eights(span, first, at, i, n, UINT8, BILINEAR, pixel == 1 ? PLANES : INTERLEAVED);
}

/* Makes pixels i ... n - 1, at least sixteen from 0 on: some before i again, if registers would not be full */
INLINE void fixed_point(Span *span, const Image *image, char *first, const Chunk *at, int64_t i, int64_t n, int mode,
                        int pixel) {
    const int64_t step = pixel == 1 ? 16 : STEP;
    const float across = fabsf(at->u[n - 1] - at->u[i]), down = fabsf(at->v[n - 1] - at->v[i]);
    /* whether windows may hold most of them */
    const int few = across * STEP < 13 * (float)(n - i) && down * STEP < 4 * (float)(n - i);
    const int near = pixel == 1 ? few && image->width >= 16 && image->height >= FIVE_ROWS : image->height > 1;
    Windows windows;
    if (near && pixel == 1) windows_of(image, at, i, n, &windows);
    while (i < n) {
        if (near && pixel == 1) i = sixteens_of(image, &windows, first, at, i, n, mode);
        else if (near) i = eights_of(image, first, at, i, n, pixel);
        if (i >= n) return;
        if (n - i < step) i = n - step;
        const int64_t end = near ? i + step : n - (n - i) % step;
        off_windows(span, image, first, at, i, end, mode, pixel);
        i = end;
    }
}

#endif

/* -- sixteen pixels at a time, whose neighbours are picked out of whole registers */

#if WIDE

/* Squares that begin within four rows, and lie within a part of these that registers hold */
typedef struct {
    __m512i x, y;  /* elements from the begin of that part, rows from the first one on */
    int64_t begin; /* of the part, from the image's first element on */
} WideWindow;

INLINE int32_t whole(float x) { return _mm_cvttss_si32(_mm_set_ss(x)); }

/* Whether squares of positions at (x, y) are all `good` and lie in so many rows and 32 elements of each */
INLINE int in_window(const Image *image, const float *u, const float *v, __m512i x, __m512i y, __mmask16 good,
                     const int rows, WideWindow *window) {
    const int64_t x0 = whole(u[0]), x15 = whole(u[15]), y0 = whole(v[0]), y15 = whole(v[15]);
    const int64_t column = x0 < x15 ? x0 : x15, row = y0 < y15 ? y0 : y15;
    const int64_t last_begin = image->width - 32, last_row = image->height - rows;
    const int64_t begin = column < last_begin ? column : last_begin, first = row < last_row ? row : last_row;
    window->x = _mm512_sub_epi32(x, _mm512_set1_epi32((int32_t)begin));
    window->y = _mm512_sub_epi32(y, _mm512_set1_epi32((int32_t)first));
    window->begin = first * image->below + begin;
    /* as unsigned numbers, so not negative either */
    good = _mm512_mask_cmple_epu32_mask(good, window->x, _mm512_set1_epi32(30));
    return _mm512_mask_cmple_epu32_mask(good, window->y, _mm512_set1_epi32(rows - 2)) == 0xffff;
}

/* How many rows hold squares whose positions go on evenly: two, three or five, or more */
INLINE int rows_of_sixteen(const float *v) {
    const int32_t first = whole(v[0]), last = whole(v[15]);
    return first == last ? 2 : (first < last ? first + 1 == last : last + 1 == first) ? 3 : 5;
}

INLINE void floats_of_sixteen(const Image *image, char *result, const WideWindow *window, __m512 u, __m512 v,
                              const int rows) {
    const float *from = (const float *)image->source + window->begin;
    const __m512 one = _mm512_set1_ps(1);
    const __m512i left = window->x, right = _mm512_add_epi32(left, _mm512_set1_epi32(1));
    int64_t c;
    int k;
    for (c = 0; c < image->channels; c++, from += image->from_plane, result += image->to_plane * 4) {
        const float *row = from;
        __m512 above, under, made;
        ask_below(from, image->below * (int64_t)sizeof(float));
        for (k = 0; k < rows; k++, row += image->below) {
            const __m512 low = _mm512_loadu_ps(row), high = _mm512_loadu_ps(row + 16);
            const __mmask16 here = _mm512_cmpge_epi32_mask(window->y, _mm512_set1_epi32(k));
            const __mmask16 before = _mm512_cmpge_epi32_mask(window->y, _mm512_set1_epi32(k - 1));
            made = _mm512_fmadd_ps(_mm512_permutex2var_ps(low, left, high), _mm512_sub_ps(one, u),
                                   _mm512_mul_ps(_mm512_permutex2var_ps(low, right, high), u));
            if (k < rows - 1) above = k ? _mm512_mask_mov_ps(above, here, made) : made;
            if (k) under = k > 1 ? _mm512_mask_mov_ps(under, before, made) : made;
        }
        _mm512_storeu_ps((float *)result, _mm512_fmadd_ps(above, _mm512_sub_ps(one, v), _mm512_mul_ps(under, v)));
    }
}

/* Whether there is such a way, and the pixels of floats are made */
INLINE int sixteen(const Image *image, char *result, const float *at_u, const float *at_v) {
    const int32_t right = (int32_t)image->width - 1, bottom = (int32_t)image->height - 1;
    const __m512 u = _mm512_loadu_ps(at_u), v = _mm512_loadu_ps(at_v);
    const int rows = rows_of_sixteen(at_v);
    const __m512i x = _mm512_min_epi32(_mm512_cvttps_epi32(u), _mm512_set1_epi32(right - 1));
    const __m512i y = _mm512_min_epi32(_mm512_cvttps_epi32(v), _mm512_set1_epi32(bottom - 1));
    const __m512 across = _mm512_sub_ps(u, _mm512_cvtepi32_ps(x)), down = _mm512_sub_ps(v, _mm512_cvtepi32_ps(y));
    WideWindow window;
    __mmask16 good = _mm512_cmp_ps_mask(u, _mm512_setzero_ps(), _CMP_GE_OQ);
    good = _mm512_mask_cmp_ps_mask(good, v, _mm512_setzero_ps(), _CMP_GE_OQ);
    good = _mm512_mask_cmp_ps_mask(good, u, _mm512_set1_ps((float)right), _CMP_LE_OQ);
    good = _mm512_mask_cmp_ps_mask(good, v, _mm512_set1_ps((float)bottom), _CMP_LE_OQ);
#define WITHIN(rows) in_window(image, at_u, at_v, x, y, good, rows, &window)
    if (rows == 2 && WITHIN(2)) floats_of_sixteen(image, result, &window, across, down, 2);
    else if (rows <= 3 && WITHIN(3)) floats_of_sixteen(image, result, &window, across, down, 3);
    else if (WITHIN(5)) floats_of_sixteen(image, result, &window, across, down, 5);
    else return 0;
#undef WITHIN
    return 1;
}

/* Of four bytes each that are moved: whether all lie on the image, and are made */
INLINE int nearest_of_sixteen(const Image *image, char *result, const float *at_u, const float *at_v) {
    const __m512 u = _mm512_loadu_ps(at_u), v = _mm512_loadu_ps(at_v), zero = _mm512_setzero_ps();
    const char *from = image->source;
    __mmask16 good = _mm512_cmp_ps_mask(u, zero, _CMP_GE_OQ);
    good = _mm512_mask_cmp_ps_mask(good, v, zero, _CMP_GE_OQ);
    good = _mm512_mask_cmp_ps_mask(good, u, _mm512_set1_ps((float)(image->width - 1)), _CMP_LE_OQ);
    good = _mm512_mask_cmp_ps_mask(good, v, _mm512_set1_ps((float)(image->height - 1)), _CMP_LE_OQ);
    if (good != 0xffff) return 0;
    const __m512i down = _mm512_mullo_epi32(_mm512_cvtps_epi32(v), _mm512_set1_epi32((int32_t)image->below));
    const __m512i at = _mm512_add_epi32(down, _mm512_cvtps_epi32(u));
    for (int64_t c = 0; c < image->channels; c++, from += image->from_plane * 4, result += image->to_plane * 4) {
        ask_below(from + (whole(at_v[0]) * image->below + whole(at_u[0])) * 4, image->below * 4);
        _mm512_storeu_si512(result, _mm512_i32gather_epi32(at, from, 4));
    }
    return 1;
}

/* -- thirty-two pixels of bytes at a time, whose neighbours are picked out of a window of some rows */

enum { MOST_ROWS = 24 };

/* Of the bytes of 32 pixels with three channels: the pixel, and the channel with that of the next pixel */
#define REPEATED(f)                                                                                                    \
    f(0), f(1), f(2), f(3), f(4), f(5), f(6), f(7), f(8), f(9), f(10), f(11), f(12), f(13), f(14), f(15), f(16), f(17), \
        f(18), f(19), f(20), f(21), f(22), f(23), f(24), f(25), f(26), f(27), f(28), f(29), f(30), f(31)
#define THREE_TIMES(i) i, i, i
#define THREE(i) 0x0300, 0x0401, 0x0502
static const int16_t PIXELS[96] = {REPEATED(THREE_TIMES)}, CHANNELS[96] = {REPEATED(THREE)};
#define OF_THREE(i) 0, 1, 2
static const uint8_t THIRDS[96] = {REPEATED(OF_THREE)}; /* channels of bytes */
#define ODD(i) 2 * (i) + 1
static const uint8_t UPPER[64] = {REPEATED(ODD)}; /* bytes of words */

/* Where 32 pixels are read: of some rows from y on, windows that begin at pixel x */
typedef struct {
    float x, y;
    int64_t begin;   /* of the first window, in elements */
    int64_t columns; /* that lie in the window and on the image */
    int64_t rows;    /* none if there are no such windows */
} Place;

/* Positions hardly go any further between three of 32. Pixels of one element or of three. `off`: whether the window may
 * reach beyond the image, by a pixel on the left and above and by two on the other sides. */
INLINE Place place_of(const Image *image, const float *u, const float *v, const int pixel, const int registers,
                      const int off) {
    const int64_t most = 64 * registers / pixel;
    const float least = (float)-off, last = (float)(image->width - most + 2 * off);
    const float left = lesser(u[0], u[31]) - 1;
    const float top = lesser(lesser(v[0], v[31]), v[16]) - 0.0625f;
    const int64_t end = whole(greater(greater(v[0], v[31]), v[16]) + 0.0625f) + 2;
    const int64_t x = whole(greater(lesser(left, last), least) - least) - off, y = whole(greater(top, least) - least) - off;
    const int64_t rows = (off || end < image->height ? end : image->height) - y;
    Place place;
    place.x = (float)x, place.y = (float)y;
    place.begin = y * image->below + pixel * x;
    place.columns = off || image->width - x > most ? most : image->width - x;
    place.rows = image->width >= 2 && rows >= 2 && rows <= MOST_ROWS ? rows : 0;
    return place;
}

/* The lower or upper halves of 32 numbers */
INLINE __m512i halves(__m512i first, __m512i second, int upper) {
    const __m512i even = _mm512_setr_epi32(0x00020000, 0x00060004, 0x000a0008, 0x000e000c, 0x00120010, 0x00160014,
                                           0x001a0018, 0x001e001c, 0x00220020, 0x00260024, 0x002a0028, 0x002e002c,
                                           0x00320030, 0x00360034, 0x003a0038, 0x003e003c);
    return _mm512_permutex2var_epi16(first, _mm512_add_epi16(even, _mm512_set1_epi16((short)upper)), second);
}

/* Between two numbers in 2^-7 of bytes, at 2 t - 1 in 2^-15; the result in 2^-8 */
INLINE __m512i between16(__m512i a, __m512i b, __m512i t) {
    return _mm512_add_epi16(_mm512_add_epi16(a, b), _mm512_mulhrs_epi16(_mm512_sub_epi16(b, a), t));
}

/* Between the two bytes of each of 32 words; the result in 2^-7 */
INLINE __m512i between_bytes(__m512i pairs, __m512i t) {
    const __m512i sum = _mm512_maddubs_epi16(pairs, _mm512_set1_epi16(0x4040));
    const __m512i difference = _mm512_maddubs_epi16(pairs, _mm512_set1_epi16(0x40c0));
    return _mm512_add_epi16(sum, _mm512_mulhrs_epi16(difference, t));
}

/* The bytes of a window, in registers, that lie on the image; and those off it */
typedef struct {
    __mmask64 held[4];
    __m512i fill[4];
} Bytes;

/* Bytes of a row of a window of so many registers; `off`: the row lies off the image, or a part of it may */
INLINE __m512i found(const char *from, const Bytes *bytes, const int is_there, __m512i pick, const int registers,
                     const int off) {
#define LOADED(k)                                                                                                      \
    (off ? _mm512_mask_loadu_epi8(bytes->fill[k], is_there ? bytes->held[k] : 0, from + 64 * (k))                      \
         : _mm512_maskz_loadu_epi8(bytes->held[k], from + 64 * (k)))
    const __m512i low = LOADED(0);
    if (registers == 1) return _mm512_permutexvar_epi8(pick, low);
    const __m512i first = _mm512_permutex2var_epi8(low, pick, LOADED(1));
    if (registers == 2) return first;
    const __m512i second = _mm512_permutex2var_epi8(LOADED(2), pick, LOADED(3));
#undef LOADED
    return _mm512_mask_mov_epi8(first, _mm512_movepi8_mask(pick), second);
}

/* Whether all lie there, and are made: pixels of one byte or of three, in rows of so many registers. Positions are
 * rounded to 2^-16. `fill` of the channels where the window lies `off` the image. */
INLINE int bytes_at(const Image *image, const Place *place, char *result, const float *u, const float *v, const int pixel,
                    const int registers, const int mode, const int off, const uint8_t *fill) {
    const int64_t rows = place->rows, x = (int64_t)place->x, y = (int64_t)place->y;
    int64_t c;
    int j, k;
    if (!rows) return 0;
    /* as numbers from 128 on, whose upper halves say the pixel in the window, and the lower ones the part of its side */
    const __m512 from_u = _mm512_set1_ps(128 - place->x), from_v = _mm512_set1_ps(128 - place->y);
#define NUMBERS(x, from)                                                                                               \
    _mm512_castps_si512(_mm512_add_ps(                                                                                 \
        mode == NEAREST ? _mm512_roundscale_ps(_mm512_loadu_ps(x), 0) : _mm512_loadu_ps(x), from))
    const __m512i u0 = NUMBERS(u, from_u), u1 = NUMBERS(u + 16, from_u);
    const __m512i v0 = NUMBERS(v, from_v), v1 = NUMBERS(v + 16, from_v);
#undef NUMBERS
    const int beyond = mode == NEAREST ? 1 : 2;
    const __m512i begin = _mm512_set1_epi16(0x4300), middle = _mm512_set1_epi16((short)0x8000);
    const __m512i column = _mm512_sub_epi16(halves(u0, u1, 1), begin);
    const __m512i row = _mm512_sub_epi16(halves(v0, v1, 1), begin);
    const __mmask32 good = _mm512_cmple_epu16_mask(column, _mm512_set1_epi16((short)(place->columns - beyond)));
    if (_mm512_mask_cmple_epu16_mask(good, row, _mm512_set1_epi16((short)(rows - beyond))) != 0xffffffffu) return 0;
    const __m512i part_u = _mm512_xor_si512(halves(u0, u1, 0), middle);
    const __m512i part_v = _mm512_xor_si512(halves(v0, v1, 0), middle);
    const __m512i at = _mm512_mullo_epi16(column, _mm512_set1_epi16((short)(0x0101 * pixel)));
    /* of a register of the result each: which pixels and channels its elements are */
    __m512i pick[3], t_u[3], t_v[3], begins[3], last[3], upper[3], lower[3];
    if (pixel == 1) {
        pick[0] = _mm512_add_epi16(at, _mm512_set1_epi16(0x0100)), t_u[0] = part_u, t_v[0] = part_v, begins[0] = row;
    } else {
        for (k = 0; k < 3; k++) {
            const __m512i which = _mm512_loadu_si512(PIXELS + 32 * k);
            const __m512i channel = _mm512_loadu_si512(CHANNELS + 32 * k);
            pick[k] = _mm512_add_epi16(_mm512_permutexvar_epi16(which, at), channel);
            t_u[k] = _mm512_permutexvar_epi16(which, part_u), t_v[k] = _mm512_permutexvar_epi16(which, part_v);
            begins[k] = _mm512_permutexvar_epi16(which, row);
        }
    }
    Bytes bytes;
    for (k = 0; k < registers; k++) {
        const int64_t end = (off ? image->width - x : place->columns) * pixel - 64 * k, before = off ? -x * pixel - 64 * k : 0;
        bytes.held[k] = end >= 64 ? ~0ull : end > 0 ? ~0ull >> (64 - end) : 0;
        if (before > 0) bytes.held[k] &= ~0ull << before;
        if (off && pixel > 1)
            bytes.fill[k] = _mm512_permutexvar_epi8(_mm512_loadu_si512(THIRDS + k % 3),
                                                    _mm512_set1_epi32(fill[0] | fill[1] << 8 | fill[2] << 16));
    }
#define IS_THERE(j) (!off || (y + (j) >= 0 && y + (j) < image->height))
    const char *plane = image->source + place->begin;
    for (c = 0; c < (pixel == 1 ? image->channels : 1); c++, plane += image->from_plane, result += image->to_plane) {
        const char *from = plane + image->below;
        ask_below(from, image->below);
        if (pixel > 1) ask_below(from + 64, image->below);
        for (k = 0; k < registers && off && pixel == 1; k++) bytes.fill[k] = _mm512_set1_epi8((char)fill[c]);
        for (k = 0; k < pixel; k++) {
            upper[k] = found(plane, &bytes, IS_THERE(0), pick[k], registers, off);
            last[k] = lower[k] = found(from, &bytes, IS_THERE(1), pick[k], registers, off);
        }
        for (j = 2; j < rows; j++) {
            const __m512i before = _mm512_set1_epi16((short)(j - 2));
            from += image->below;
            for (k = 0; k < pixel; k++) {
                const __mmask32 below = _mm512_cmpgt_epi16_mask(begins[k], before);
                const __m512i next = found(from, &bytes, IS_THERE(j), pick[k], registers, off);
                upper[k] = _mm512_mask_mov_epi16(upper[k], below, last[k]);
                lower[k] = _mm512_mask_mov_epi16(lower[k], below, next);
                last[k] = next;
            }
        }
#undef IS_THERE
        if (mode == NEAREST) {
            const __mmask32 below = _mm512_cmpge_epi16_mask(row, _mm512_set1_epi16((short)(rows - 1)));
            const __m512i value = _mm512_mask_mov_epi16(upper[0], below, lower[0]);
            _mm256_storeu_si256((__m256i *)result, _mm512_cvtepi16_epi8(value));
            continue;
        }
        for (k = 0; k < pixel; k++) {
            const __m512i above = between_bytes(upper[k], t_u[k]), under = between_bytes(lower[k], t_u[k]);
            const __m512i value = between16(above, under, t_v[k]);
            const __m512i rounded = _mm512_add_epi16(value, _mm512_set1_epi16(128));
            const __m512i dense = _mm512_permutexvar_epi8(_mm512_loadu_si512(UPPER), rounded);
            _mm256_storeu_si256((__m256i *)(result + 32 * k), _mm512_castsi512_si256(dense));
        }
    }
    return 1;
}

#endif

#if WIDE

/* Whether 32 pixels of which some lie off the image are made, in windows that reach beyond it */
INLINE int bytes_around(const Job *job, const Image *image, char *result, const float *u, const float *v, const int pixel,
                        const int registers, const int mode) {
    const __m512 off = _mm512_set1_ps(-1);
    _Alignas(64) float at[2][32];
    int k;
    for (k = 0; k < 4; k++) { /* what lies farther off, or is not a number, shows as little as the next pixels off it */
        const float *from = (k < 2 ? u : v) + k % 2 * 16;
        const __m512 side = _mm512_set1_ps((float)(k < 2 ? image->width : image->height));
        _mm512_store_ps(at[k / 2] + k % 2 * 16, _mm512_min_ps(_mm512_max_ps(_mm512_loadu_ps(from), off), side));
    }
    const Place place = place_of(image, at[0], at[1], pixel, registers, 1);
    return bytes_at(image, &place, result, at[0], at[1], pixel, registers, mode, 1, (const uint8_t *)job->fill_elements);
}

/* Apart from the pixels on the image, whose loops it would take registers from */
NOT_INLINE int around(const Job *job, const Image *image, char *result, const float *u, const float *v, int pixel,
                      int registers, int mode) {
    if (job->padding != ZEROS || (mode != NEAREST && !(is_small(image) && fills_bytes(job, image)))) return 0;
#define AROUND(pixel, registers, mode) bytes_around(job, image, result, u, v, pixel, registers, mode)
    if (mode == NEAREST) return registers == 1 ? AROUND(1, 1, NEAREST) : AROUND(1, 2, NEAREST);
    if (pixel == 1) return registers == 1 ? AROUND(1, 1, BILINEAR) : AROUND(1, 2, BILINEAR);
    return registers == 2 ? AROUND(3, 2, BILINEAR) : AROUND(3, 4, BILINEAR);
#undef AROUND
}

/* Makes pixels i ... n - 1, at least 32: the last of them again, if they fill no registers */
INLINE void wide_bytes(Span *span, const Image *image, char *first, const Chunk *at, int64_t i, int64_t n,
                       const int pixel, const int registers, int mode) {
    Place places[CHUNK / 32];
    int64_t k, begin;
#define BEGIN(k) (i + 32 * (k) < n - 32 ? i + 32 * (k) : n - 32)
    for (k = 0; i + 32 * k < n; k++) places[k] = place_of(image, at->u + BEGIN(k), at->v + BEGIN(k), pixel, registers, 0);
    for (k = 0; i + 32 * k < n; k++) {
        begin = BEGIN(k);
        const float *u = at->u + begin, *v = at->v + begin;
        char *result = first + begin * pixel;
        if (!bytes_at(image, places + k, result, u, v, pixel, registers, mode, 0, NULL) &&
            !around(span->job, image, result, u, v, pixel, registers, mode))
            off_windows(span, image, first, at, begin, begin + 32, mode, pixel);
    }
#undef BEGIN
}

/* Makes pixels i ... n - 1 of a row, up to the one that it returns */
INLINE int64_t wide(Span *span, char *first, const Chunk *at, int64_t i, int64_t n, int type, int mode, int layout) {
    const Job *job = span->job;
    const int64_t *from = job->source_strides, *to = job->result_strides;
    const Image image = {span->source, job->channels, from[1], from[2], to[1], job->source_width, job->source_height};
    const int in_planes = layout == PLANES || (mode == NEAREST && from[3] == 1 && to[3] == 1);
    if (mode == BILINEAR && type == FLOAT32 && in_planes && image.width >= 32 && image.height >= 5) {
        for (; n - i >= 16; i += 16)
            if (!sixteen(&image, first + 4 * i, at->u + i, at->v + i))
                eights(span, first, at, i, i + 16, FLOAT32, BILINEAR, PLANES);
        return i;
    }
    if (mode == NEAREST && type == BYTES4 && in_planes && llabs(image.below) * image.height + image.width < INT32_MAX) {
        for (; n - i >= 16; i += 16)
            if (!nearest_of_sixteen(&image, first + 4 * i, at->u + i, at->v + i))
                eights(span, first, at, i, i + 16, BYTES4, NEAREST, SCATTERED);
        return i;
    }
    if (!(mode == BILINEAR ? type == UINT8 : mode == NEAREST && type == BYTES1) || n - i < 32) return i;
    if (!in_planes && !(layout == INTERLEAVED && job->channels == 3)) return i;
    /* how far 32 pixels go */
    const int64_t across = llabs((int64_t)whole(at->u[n - 1]) - whole(at->u[i])) * 32 / (n - i) + 5;
    const int64_t down = llabs((int64_t)whole(at->v[n - 1]) - whole(at->v[i])) * 32 / (n - i);
    if (down > MOST_ROWS || across > (in_planes ? 128 : 85)) return i;
    if (in_planes && across <= 64) wide_bytes(span, &image, first, at, i, n, 1, 1, mode);
    else if (in_planes) wide_bytes(span, &image, first, at, i, n, 1, 2, mode);
    else if (across <= 42) wide_bytes(span, &image, first, at, i, n, 3, 2, BILINEAR);
    else wide_bytes(span, &image, first, at, i, n, 3, 4, BILINEAR);
    return n;
}

#endif

#if VECTORS

/* Brings positions of n pixels along one axis onto the image, as the padding reads it; NaN stays */
NOT_INLINE void pad(const float *x, float *to, int64_t n, int64_t side, int padding, int type) {
    /* the last pixel belongs to the square before it, as bytes are interpolated */
    const float end = (float)(side - 1), last = type == UINT8 ? end - greater(end, 128) * 1.2e-7f : end;
    const V8 far = every8(2097152.0f);
    int64_t i;
    int k;
    for (i = 0; i < n; i += STEP) {
        V8 at = load8(x + i);
        if (padding == REFLECTION && !all8((at >= every8(0)) & (at <= every8(end)))) {
            if (all8((at > -far) & (at < far))) at = reflected8(at, (float)side);
            else
                for (k = 0; k < STEP; k++) at[k] = at[k] == at[k] ? reflected(at[k], (float)side) : at[k];
        }
        at = clamped8(at, greater(last, 0));
        memcpy(to + i, &at, sizeof at);
    }
    to[i] = to[i - 1];
}

#endif

INLINE void chunk(Span *span, char *first, const Chunk *at, int64_t n, int type, int mode, int layout) {
    int64_t i = 0;
#if VECTORS
    const Job *job = span->job;
    Chunk on_image;
    const int64_t step = job->result_strides[3] * size_of(type);
    int64_t end = (n + STEP - 1) / STEP * STEP;
    if (job->padding != ZEROS && taps_along(mode) <= 2) {
        pad(at->u, on_image.u, n, job->source_width, job->padding, type);
        pad(at->v, on_image.v, n, job->source_height, job->padding, type);
        at = &on_image;
    }
    while (i < n && shows_nothing(job, load8(at->u + i), load8(at->v + i), mode)) i += STEP;
    while (end > i && shows_nothing(job, load8(at->u + end - STEP), load8(at->v + end - STEP), mode)) end -= STEP;
    span->result = first, span->pixels = i < n ? i : n;
    if (i) show_nothing(span, type);
    if (i >= n) return;
    span->result = first + end * step, span->pixels = n - end;
    if (end < n) show_nothing(span, type), n = end;
#endif
#if WIDE
    i = wide(span, first, at, i, n, type, mode, layout);
    if (i >= n) return;
#endif
#if defined(__AVX2__)
    const int64_t *from = job->source_strides, *to = job->result_strides;
    const Image image = {span->source, job->channels, from[1], from[2], to[1], job->source_width, job->source_height};
    const int in_planes = layout == PLANES || (mode == NEAREST && from[3] == 1 && to[3] == 1);
    const int pixel = in_planes ? 1 : layout == INTERLEAVED ? (int)job->channels : 0;
    const int are_bytes = mode == BILINEAR ? type == UINT8 : mode == NEAREST && type == BYTES1;
    if (are_bytes && pixel && n >= 16 && is_small(&image)) {
        fixed_point(span, &image, first, at, i, n, mode, pixel);
        return;
    }
#endif
    eights(span, first, at, i, n, type, mode, layout);
}

/* -- tiles */

/* Makes n pixels of each of some rows */
INLINE void rows(const Job *job, const Chunk *at, int64_t b, int64_t y, int64_t count, int64_t x, int64_t n, int type,
                 int mode, int layout) {
    const int64_t *strides = job->result_strides;
    Span span;
    int64_t i;
    span.job = job;
    span.source = (const char *)job->source + b * job->source_strides[0] * size_of(type);
    for (i = 0; i < count; i++)
        chunk(&span, (char *)job->result + (b * strides[0] + (y + i) * strides[2] + x * strides[3]) * size_of(type), at + i, n,
              type, mode, layout);
}

typedef void (*Rows)(const Job *, const Chunk *, int64_t, int64_t, int64_t, int64_t, int64_t);

enum { MOST_TOGETHER = 8 }; /* images whose positions are made once */

/* Of `many` jobs of one size and the same positions */
static void tile(const Job *jobs, const Rows *make, int many, int64_t b, int64_t from, int64_t to) {
    Lines lines;
    Chunk at[STEP];
    const int64_t step = many > 1 ? STEP : 1; /* rows between two jobs */
    int64_t x, y, i;
    int k;
    for (x = 0; x < jobs->width; x += CHUNK) {
        const int64_t n = jobs->width - x < CHUNK ? jobs->width - x : CHUNK, filled = (n + STEP - 1) / STEP * STEP;
        for (y = from; y < to; y += step) {
            const int64_t count = to - y < step ? to - y : step;
            for (i = 0; i < count; i++) {
                if (jobs->nodes) lattice_positions(jobs, b, y + i, x, n, from, &lines, at + i);
                else grid_positions(jobs, b, y + i, x, n, at + i);
                at[i].u[filled] = at[i].u[filled - 1], at[i].v[filled] = at[i].v[filled - 1];
            }
            for (k = 0; k < many; k++) make[k](jobs + k, at, b, y, count, x, n);
        }
    }
}

static int layout_of(const Job *job) {
    const int64_t *from = job->source_strides, *to = job->result_strides;
    if (from[3] == 1 && to[3] == 1) return PLANES;
    if ((job->channels == 3 || job->channels == 4) && from[1] == 1 && to[1] == 1 && from[3] == job->channels &&
        to[3] == job->channels)
        return INTERLEAVED;
    return SCATTERED;
}

#define NAME(type, mode, layout) JOINED(JOINED(JOINED(rows, type), mode), layout)
#define MADE(type, mode, layout)                                                                                       \
    NOT_INLINE void NAME(type, mode, layout)(const Job *job, const Chunk *at, int64_t b, int64_t y, int64_t count,     \
                                             int64_t x, int64_t n) {                                                   \
        rows(job, at, b, y, count, x, n, type, mode, layout);                                                          \
    }
#define COMPUTED(type, mode, taps, reach, weights)                                                                     \
    MADE(type, mode, PLANES)                                                                                           \
    MADE(type, mode, INTERLEAVED)                                                                                      \
    MADE(type, mode, SCATTERED)
COMPUTING(COMPUTED, UINT8)
COMPUTING(COMPUTED, BOOL)
COMPUTING(COMPUTED, UINT16)
COMPUTING(COMPUTED, FLOAT32)
MADE(BYTES1, NEAREST, SCATTERED)
MADE(BYTES2, NEAREST, SCATTERED)
MADE(BYTES4, NEAREST, SCATTERED)
MADE(BYTES8, NEAREST, SCATTERED)

#define BY_LAYOUT(type, mode, taps, reach, weights)                                                                    \
    {NAME(type, mode, PLANES), NAME(type, mode, INTERLEAVED), NAME(type, mode, SCATTERED)},
static const Rows computed[][COMPUTING_MODES][3] = {
    {COMPUTING(BY_LAYOUT, UINT8)},
    {COMPUTING(BY_LAYOUT, BOOL)},
    {COMPUTING(BY_LAYOUT, UINT16)},
    {COMPUTING(BY_LAYOUT, FLOAT32)},
};
static const Rows moved[] = {NAME(BYTES1, NEAREST, SCATTERED), NAME(BYTES2, NEAREST, SCATTERED),
                             NAME(BYTES4, NEAREST, SCATTERED), NAME(BYTES8, NEAREST, SCATTERED)};

static Rows way_of(const Job *job) {
    if (job->mode == NEAREST) return moved[job->type - BYTES1];
    return computed[job->type][job->mode - BILINEAR][layout_of(job)];
}

/* Whole images on this thread, of each row one after the other */
void THIS(sample_images)(const Images *given) {
    Rows make[MOST_TOGETHER];
    int64_t i, from;
    int k, many;
    for (i = 0; i < given->count; i += many) {
        const Job *jobs = given->jobs + i;
        const int64_t step = jobs->tile_rows, height = jobs->height;
        many = given->count - i < MOST_TOGETHER ? (int)(given->count - i) : MOST_TOGETHER;
        for (k = 0; k < many; k++) make[k] = way_of(jobs + k);
        for (from = 0; from < height; from += step)
            tile(jobs, make, many, given->image, from, from + step < height ? from + step : height);
    }
}

/* Takes tiles, of those that no thread has taken, until none is left; how many it made */
int32_t THIS(sample)(Job *job) {
    const int64_t tiles = (job->height + job->tile_rows - 1) / job->tile_rows;
    const Rows make = way_of(job);
    int32_t made;
    for (made = 0;; made++) {
        const int64_t i = __atomic_fetch_add(&job->next, 1, __ATOMIC_RELAXED);
        int64_t b, from;
        if (i >= tiles * job->count) return made;
        /* one image after the other of the same rows: positions that they share are in the cache then */
        b = i % job->count;
        from = i / job->count * job->tile_rows;
        tile(job, &make, 1, b, from, from + job->tile_rows < job->height ? from + job->tile_rows : job->height);
    }
}

/* -- which cells of a lattice want exact positions */

/* By differences of differences, which numbers that lie close together have without roundings */
INLINE float fourth(float a, float b, float c, float d, float e) {
    const float ab = b - a, bc = c - b, cd = d - c, de = e - d;
    return fabsf(((de - cd) - (cd - bc)) - ((cd - bc) - (bc - ab)));
}

NOT_INLINE void windows(const float *a, const float *b, const float *c, const float *d, int64_t n, float *__restrict most) {
    int64_t j;
    for (j = 0; j < n; j++) most[j] = greater(greater(a[j], b[j]), greater(c[j], d[j]));
}

/* The largest fourth differences across and down at a line of corners, of those of a cell and the next ones on either
 * side; nodes: of the first of the five rows around it */
NOT_INLINE void misses(const float *nodes, int64_t width, int64_t n, float *line, float *across, float *down) {
    const float *r0 = nodes, *r1 = r0 + width, *r2 = r1 + width, *r3 = r2 + width, *r4 = r3 + width;
    int64_t j, k;
    for (k = 0; k < 2; k++) {
        float *most = k ? down : across;
        if (k)
            for (j = 0; j < n + 1; j++) line[j + 1] = fourth(r0[j + 2], r1[j + 2], r2[j + 2], r3[j + 2], r4[j + 2]);
        else
            for (j = 0; j < n + 1; j++) line[j + 1] = fourth(r2[j], r2[j + 1], r2[j + 2], r2[j + 3], r2[j + 4]);
        line[0] = line[1], line[n + 2] = line[n + 1];
        windows(line, line + 1, line + 2, line + 3, n, most);
    }
}

/* The range of a cell's sixteen nodes; nodes: of the first of its four rows */
static void ranges(const float *nodes, int64_t width, int64_t n, float *least, float *most, float *low, float *high) {
    const float *r0 = nodes, *r1 = r0 + width, *r2 = r1 + width, *r3 = r2 + width;
    int64_t j;
    for (j = 0; j < n + 3; j++) {
        least[j] = lesser(lesser(r0[j], r1[j]), lesser(r2[j], r3[j]));
        most[j] = greater(greater(r0[j], r1[j]), greater(r2[j], r3[j]));
    }
    for (j = 0; j < n; j++) {
        low[j] = lesser(lesser(least[j], least[j + 1]), lesser(least[j + 2], least[j + 3]));
        high[j] = greater(greater(most[j], most[j + 1]), greater(most[j + 2], most[j + 3]));
    }
}

/* Of one coordinate: adds to the squares of both, by which cubics may miss, and to whether they are near the image, 1 or
 * 0; scale: of the fourth differences across and down */
NOT_INLINE void judge(const float *across, const float *down, float scale, const float *low, const float *high, int64_t n,
                      float not_border, float not_zeros, float *__restrict missed, float *__restrict near) {
    int64_t j;
    for (j = 0; j < n; j++) {
        const float of = scale * (across[j] + down[j]);
        const float reach = CELL_MARGIN + CELL_OVERSHOOT * (high[j] - low[j]);
        const float is_near = (high[j] + reach > -1 ? 1.0f : 0.0f) * (low[j] - reach < 1 ? 1.0f : 0.0f);
        /* beyond the border, one coordinate does not matter, but the other one does */
        missed[j] += greater(is_near, not_border) * of * of;
        near[j] *= greater(is_near, not_zeros);
    }
}

/* The cells; how many want exact positions, or may, in the image with the most of them */
int32_t THIS(classify)(const Classification *given) {
    const int64_t n = given->columns, width = n + 5, area = n + 8;
    const float limit = (float)(given->tolerance * given->tolerance);
    const float half[2] = {(float)(given->source_width / 2), (float)(given->source_height / 2)};
    const float not_border = given->padding != BORDER, not_zeros = given->padding != ZEROS;
    float *lines[9], *kept[2][2][4];
    int64_t b, i, j, c, k, made;
    int32_t most = 0;
    for (k = 0; k < 9; k++) lines[k] = given->scratch + k * area;
    for (k = 0; k < 16; k++) kept[k / 8][k / 4 % 2][k % 4] = given->scratch + (9 + k) * area;
    for (b = 0; b < given->count; b++) {
        int32_t *cells = given->cells + b * given->rows * n;
        for (i = 0, made = 0; i < given->rows; i++) {
            const uint8_t *m = given->mapped + b * given->mapped_stride + (i + 1) * width + 1;
            const float *planes = given->nodes + b * given->node_strides[0];
            float *missed = lines[0], *near = lines[1];
            /* the lines of corners that this row is the first to look at */
            for (; made <= given->rows && made < i + 3; made++)
                for (c = 0; c < 2; c++) {
                    const float *nodes = planes + c * given->node_strides[1] + made * width;
                    misses(nodes, width, n, lines[2], kept[c][0][made % 4], kept[c][1][made % 4]);
                }
            for (j = 0; j < n; j++) missed[j] = 0, near[j] = 1;
            for (c = 0; c < 2; c++) {
                const float *nodes = planes + c * given->node_strides[1] + i * width;
                for (k = 0; k < 2; k++) {
                    float **of = kept[c][k];
                    windows(of[(i > 0 ? i - 1 : 0) % 4], of[i % 4], of[(i + 1) % 4],
                            of[(i + 2 < given->rows ? i + 2 : given->rows) % 4], n, lines[3 + k]);
                }
                ranges(nodes + width + 1, width, n, lines[5], lines[6], lines[7], lines[8]);
                judge(lines[3], lines[4], CELL_MISSED * half[c], lines[7], lines[8], n, not_border, not_zeros, missed,
                      near);
            }
            uint8_t *sums = (uint8_t *)lines[2];
            for (j = 0; j < n + 3; j++) sums[j] = m[j] + m[j + width] + m[j + 2 * width] + m[j + 3 * width];
            for (j = 0; j < n; j++) {
                const int sum = sums[j] + sums[j + 1] + sums[j + 2] + sums[j + 3];
                /* what is not a number is not below the limit */
                const int doubt = (near[j] > 0) & !(missed[j] <= limit);
                cells[i * n + j] = sum == 0 ? CELL_EMPTY : sum < 16 ? 0 : doubt ? CELL_DOUBT : CELL_CUBIC;
            }
        }
        /* a pixel at the rim may say that the nodes do not tell all */
        const uint8_t *rim = given->rim + b * given->rim_stride;
        const int64_t last_row = (given->rows - 1) * n, last = (given->width - 1) / STEP;
#define LOOK(cell) \
    do { \
        int32_t *at = cells + (cell); \
        if (*at != 0 && (*rim != 0) != (*at != CELL_EMPTY)) *at = 0; \
        rim++; \
    } while (0)
        for (k = 0; k < given->width; k++) LOOK(k / STEP);
        for (k = 0; k < given->width; k++) LOOK(last_row + k / STEP);
        for (k = 0; k < given->height; k++) LOOK(k / STEP * n);
        for (k = 0; k < given->height; k++) LOOK(k / STEP * n + last);
        int32_t todo = 0;
        for (k = 0; k < given->rows * n; k++) todo += cells[k] == 0 || cells[k] == CELL_DOUBT;
        most = todo > most ? todo : most;
    }
    return most;
}

/* -- pixels of a lattice, u and v side by side, and the transpose of that */

enum { LAID = 64, LAID_ROWS = 16, AROUND = 6 }; /* cells of a line, lines of cells of a strip, nodes around a cell along an axis */
typedef float Pairs[2 * LAID * STEP];
typedef float Polynomials[AROUND][STEP];

/* Of the six nodes around a cell, those of polynomials through four, or all, on the way from its first one to the next */
static void lay_weights(int64_t taps, Polynomials weights) {
    const int first = (int)(AROUND - taps) / 2, end = AROUND - first;
    int j, k, m;
    memset(weights, 0, sizeof(Polynomials));
    for (j = first; j < end; j++)
        for (k = 0; k < STEP; k++) {
            double weight = 1;
            for (m = first; m < end; m++) weight *= m == j ? 1 : ((double)k / STEP + 2 - m) / (j - m);
            weights[j][k] = (float)weight;
        }
}

/* One polynomial is laid for most cells, all at once, and the other one for some */
typedef struct {
    Polynomials most, some;
    int32_t usual, rare; /* the cells of each */
} Kinds;

static void lay_kinds(const Laying *given, Kinds *kinds) {
    int64_t i, quintics = 0, cubics = 0;
    for (i = 0; i < given->count * given->rows * given->columns; i++) {
        cubics += given->cells[i] == CELL_CUBIC;
        quintics += given->cells[i] == CELL_QUINTIC;
    }
    lay_weights(quintics > cubics ? 6 : 4, kinds->most), lay_weights(quintics > cubics ? 4 : 6, kinds->some);
    kinds->usual = quintics > cubics ? CELL_QUINTIC : CELL_CUBIC, kinds->rare = CELL_QUINTIC + CELL_CUBIC - kinds->usual;
}

/* Some rows of cells of a camera, from the one at `first` on */
static void lay_strip(const Laying *given, const Kinds *kinds, int64_t b, int64_t first, int64_t end) {
    const float(*w)[STEP] = kinds->most, (*r)[STEP] = kinds->some;
    const int64_t width = given->columns + 5, plane = (given->rows + 5) * width, far = given->exact_count * STEP * STEP;
    int64_t column, i, j, y;
    int k, c;
    for (column = 0; column < given->columns; column += LAID) {
        const int64_t left = given->columns - column, count = left < LAID ? left : LAID, x = column * STEP;
        const int64_t n = given->width - x < count * STEP ? given->width - x : count * STEP;
        _Alignas(64) Pairs lines[AROUND];
        uint8_t mapped[LAID * STEP];
        for (i = first; i < end; i++) {
            const int32_t *cells = given->cells + (b * given->rows + i) * given->columns + column;
            for (j = i == first ? i : i + AROUND - 1; j < i + AROUND; j++) {
                const float *u = given->nodes + 2 * b * plane + j * width + column, *v = u + plane;
                for (y = 0; y < count; y++)
                    for (k = 0; k < STEP; k++) {
                        float *to = lines[j % AROUND] + 2 * (y * STEP + k), sums[2] = {0, 0};
                        for (c = 0; c < AROUND; c++) sums[0] += w[c][k] * u[y + c], sums[1] += w[c][k] * v[y + c];
                        to[0] = sums[0], to[1] = sums[1];
                    }
            }
            for (j = 0; j < count; j++) memset(mapped + j * STEP, cells[j] != CELL_EMPTY, STEP);
            const float *l0 = lines[i % AROUND], *l1 = lines[(i + 1) % AROUND], *l2 = lines[(i + 2) % AROUND];
            const float *l3 = lines[(i + 3) % AROUND], *l4 = lines[(i + 4) % AROUND], *l5 = lines[(i + 5) % AROUND];
            for (y = i * STEP; y < (i + 1) * STEP && y < given->height; y++) {
                const int64_t at = (b * given->height + y) * given->width + x;
                const int part = (int)(y % STEP);
                float *__restrict to = given->grid + 2 * at;
                const float w0 = w[0][part], w1 = w[1][part], w2 = w[2][part], w3 = w[3][part], w4 = w[4][part];
                const float w5 = w[5][part];
                for (j = 0; j < 2 * n; j++)
                    to[j] = l0[j] * w0 + l1[j] * w1 + l2[j] * w2 + l3[j] * w3 + l4[j] * w4 + l5[j] * w5;
                memcpy(given->mapped + at, mapped, (size_t)n);
                for (j = 0; j < n; j++) {
                    const int32_t cell = cells[j / STEP];
                    if (cell == kinds->usual) {
                        j += STEP - 1;
                    } else if (cell == kinds->rare) {
                        const float *node = given->nodes + 2 * b * plane + i * width + column + j / STEP;
                        to[2 * j] = to[2 * j + 1] = 0;
                        for (c = 0; c < AROUND * AROUND; c++) {
                            const float weight = r[c / AROUND][part] * r[c % AROUND][j % STEP];
                            to[2 * j] += weight * node[c / AROUND * width + c % AROUND];
                            to[2 * j + 1] += weight * node[c / AROUND * width + c % AROUND + plane];
                        }
                    } else {
                        const float *exact = given->exact + (cell * (int64_t)STEP + part) * STEP + j % STEP;
                        const int known = cell != CELL_EMPTY && exact[0] == exact[0];
                        to[2 * j] = known ? exact[0] : -9, to[2 * j + 1] = known ? exact[far] : -9;
                        given->mapped[at + j] = (uint8_t)known;
                    }
                }
            }
        }
    }
}

/* Adds what a line of gradients says to those of a row of nodes, and clears the line */
static void gather_line(const Polynomials w, float *line, int64_t count, float *u, float *v) {
    float turned[2 * STEP][LAID]; /* a row of cells for each of their pixels */
    int64_t j;
    int k, c;
    for (j = 0; j < count; j++)
        for (k = 0; k < 2 * STEP; k++) turned[k][j] = line[2 * STEP * j + k];
    for (c = 0; c < AROUND; c++)
        for (k = 0; k < STEP; k++) {
            for (j = 0; j < count; j++) u[j + c] += w[c][k] * turned[2 * k][j];
            for (j = 0; j < count; j++) v[j + c] += w[c][k] * turned[2 * k + 1][j];
        }
    memset(line, 0, (size_t)count * 2 * STEP * sizeof *line);
}

/* Adds a row of gradients to those of the six lines that it lies between, at `part` / 8 from the third to the fourth one */
NOT_INLINE void spread_row(const Polynomials w, int part, const float *from, int64_t n, float *__restrict l0,
                           float *__restrict l1, float *__restrict l2, float *__restrict l3, float *__restrict l4,
                           float *__restrict l5) {
    const float w0 = w[0][part], w1 = w[1][part], w2 = w[2][part], w3 = w[3][part], w4 = w[4][part], w5 = w[5][part];
    int64_t j;
    for (j = 0; j < n; j++) {
        const float g = from[j];
        l0[j] += w0 * g, l1[j] += w1 * g, l2[j] += w2 * g, l3[j] += w3 * g, l4[j] += w4 * g, l5[j] += w5 * g;
    }
}

/* The gradients of a camera's nodes and exact positions */
static void gather(const Laying *given, const Kinds *kinds, int64_t b) {
    const float(*w)[STEP] = kinds->most, (*r)[STEP] = kinds->some;
    const int64_t width = given->columns + 5, plane = (given->rows + 5) * width, far = given->exact_count * STEP * STEP;
    int64_t column, i, j, y;
    int c;
    for (column = 0; column < given->columns; column += LAID) {
        const int64_t left = given->columns - column, count = left < LAID ? left : LAID, x = column * STEP;
        const int64_t n = given->width - x < count * STEP ? given->width - x : count * STEP;
        float *nodes = given->nodes + 2 * b * plane + column;
        _Alignas(64) Pairs lines[AROUND], own;
        memset(lines, 0, sizeof lines);
        for (i = 0; i < given->rows + AROUND - 1; i++) {
            const int32_t *cells = given->cells + (b * given->rows + i) * given->columns + column;
            int usual = 1;
            for (j = 0; j < count && i < given->rows; j++) usual &= cells[j] == kinds->usual;
            for (y = i * STEP; y < (i + 1) * STEP && y < given->height; y++) {
                const int part = (int)(y % STEP);
                const float *from = given->grid + 2 * ((b * given->height + y) * given->width + x);
                for (j = 0; j < n && !usual; j++) {
                    const int32_t cell = cells[j / STEP];
                    const int is_usual = cell == kinds->usual;
                    own[2 * j] = is_usual ? from[2 * j] : 0, own[2 * j + 1] = is_usual ? from[2 * j + 1] : 0;
                    if (cell == kinds->rare) {
                        float *node = nodes + i * width + j / STEP;
                        for (c = 0; c < AROUND * AROUND; c++) {
                            const float weight = r[c / AROUND][part] * r[c % AROUND][j % STEP];
                            node[c / AROUND * width + c % AROUND] += weight * from[2 * j];
                            node[c / AROUND * width + c % AROUND + plane] += weight * from[2 * j + 1];
                        }
                    } else if (!is_usual && cell != CELL_EMPTY) {
                        float *exact = given->exact + (cell * (int64_t)STEP + part) * STEP + j % STEP;
                        exact[0] = from[2 * j], exact[far] = from[2 * j + 1];
                    }
                }
                spread_row(w, part, usual ? from : own, 2 * n, lines[i % AROUND], lines[(i + 1) % AROUND],
                           lines[(i + 2) % AROUND], lines[(i + 3) % AROUND], lines[(i + 4) % AROUND], lines[(i + 5) % AROUND]);
            }
            gather_line(w, lines[i % AROUND], count, nodes + i * width, nodes + i * width + plane);
        }
    }
}

void THIS(lay)(Laying *given) {
    const int64_t strips = given->is_transposed ? 1 : (given->rows + LAID_ROWS - 1) / LAID_ROWS;
    int64_t i;
    Kinds kinds;
    lay_kinds(given, &kinds);
    while ((i = __atomic_fetch_add(&given->next, 1, __ATOMIC_RELAXED)) < strips * given->count) {
        const int64_t first = i % strips * LAID_ROWS, end = first + LAID_ROWS;
        if (given->is_transposed) gather(given, &kinds, i);
        else lay_strip(given, &kinds, i / strips, first, end < given->rows ? end : given->rows);
    }
}
