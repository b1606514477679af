/* One pixel at a time, of every type, mode, padding and layout: the way of all that vectors cannot make, and in the variant
 * without vectors of everything, with which tests compare the others.
 */

/* What a group of pixels is written to and read from */
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

/* How pixels lie in memory, in source and result */
enum { PLANES, INTERLEAVED, SCATTERED };

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
static NOT_INLINE Taps taps_at(const Job *job, float u, float v, int mode) {
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

static NOT_INLINE void show_nothing(const Span *span, int type) {
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
static NOT_INLINE void careful(const Span *span, const float *at_u, const float *at_v, int type, int mode, uint32_t done) {
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
