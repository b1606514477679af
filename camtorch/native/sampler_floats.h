/* LANES pixels at a time in floats, of every type, on every kind of CPU; what is off the image goes one by one. */

enum { MOST_INTERLEAVED = 4 }; /* channels */
enum { ROWS_AHEAD = 8 };       /* of the source */

#if VECTORS

/* Asks for what lies some rows below: rows are too short for a CPU to see by itself that they are read on and on.
 * An address alone, which need not be one of the image. */
INLINE void ask_below(const void *from, int64_t below) {
    __builtin_prefetch((const char *)((uintptr_t)from + (uintptr_t)(ROWS_AHEAD * below)));
}

/* Where pixels are read: from the corner (x, y) of a square of four pixels, at a part of its sides */
typedef struct {
    Wholes x, y;
    Floats u, v; /* parts of the right column and of the lower row */
} Squares;

/* Whether all lie on the image, with `right` and `below` more pixels to the right and below */
INLINE int inside(const Job *job, Floats u, Floats v, float before, float beyond) {
    const Floats low = every(before);
    const Floats right = every((float)(job->source_width - 1) - beyond);
    const Floats below = every((float)(job->source_height - 1) - beyond);
    return all_true((u >= low) & (u <= right) & (v >= low) & (v <= below));
}

/* Whether no square begins in the last `beyond` columns or in the last row */
INLINE Squares squares_of(const Job *job, Floats u, Floats v, int32_t beyond) {
    Squares at;
    at.x = lesser_of(truncated(u), every_whole((int32_t)job->source_width - 1 - beyond));
    at.y = lesser_of(truncated(v), every_whole((int32_t)job->source_height - 2));
    at.u = u - as_floats(at.x);
    at.v = v - as_floats(at.y);
    return at;
}

/* -- pixels of one channel whose neighbours in a row are neighbours in memory */

INLINE void store_floats(char *to, Floats value, int64_t n) {
    if (n == LANES) memcpy(to, &value, sizeof value);
    else memcpy(to, &value, (size_t)n * sizeof(float));
}

INLINE void store_bytes(char *to, Wholes value, int64_t n) {
    typedef int16_t W8 __attribute__((vector_size(2 * LANES)));
    typedef uint8_t B8 __attribute__((vector_size(LANES)));
    const B8 bytes = __builtin_convertvector(__builtin_convertvector(value, W8), B8); /* in steps compilers know */
    if (n == LANES) memcpy(to, &bytes, sizeof bytes);
    else memcpy(to, &bytes, (size_t)n);
}

INLINE void store_words(char *to, Wholes value, int64_t n) {
    typedef uint16_t W8 __attribute__((vector_size(2 * LANES)));
    W8 words = __builtin_convertvector(value, W8);
    memcpy(to, &words, (size_t)n * 2);
}

/* Pixels of an image, of any rows */
INLINE Floats gathered(const char *from, const int64_t *at, int type) {
    Floats floats;
    Wholes whole;
    int i;
    for (i = 0; i < LANES; i++) {
        if (type == FLOAT32) floats[i] = ((const float *)from)[at[i]];
        else if (type == UINT16) whole[i] = ((const uint16_t *)from)[at[i]];
        else whole[i] = ((const uint8_t *)from)[at[i]];
    }
    return type == FLOAT32 ? floats : as_floats(whole);
}

/* Pairs of neighbours in a row, between which `part` lies */
INLINE Floats between_pairs(const char *from, const int64_t *at, Floats part, int type) {
    Floats left, right;
#if defined(__AVX2__)
    if (type == FLOAT32) {
#define PAIR(i) from + 4 * at[i]
        const __m256 even = _mm256_castsi256_ps(quarters(PAIR(0), PAIR(1), PAIR(4), PAIR(5)));
        const __m256 odd = _mm256_castsi256_ps(quarters(PAIR(2), PAIR(3), PAIR(6), PAIR(7)));
#undef PAIR
        left = (Floats)_mm256_shuffle_ps(even, odd, 0x88), right = (Floats)_mm256_shuffle_ps(even, odd, 0xdd);
        return left * (1 - part) + right * part;
    }
#elif NEON
    if (type == FLOAT32) {
#define PAIR(i) vld1_f32((const float *)from + at[i])
        const float32x4_t even = vcombine_f32(PAIR(0), PAIR(1)), odd = vcombine_f32(PAIR(2), PAIR(3));
#undef PAIR
        left = vuzp1q_f32(even, odd), right = vuzp2q_f32(even, odd);
        return left * (1 - part) + right * part;
    }
#endif
    left = gathered(from, at, type), right = gathered(from + size_of(type), at, type);
    return left * (1 - part) + right * part;
}

/* Where pixels lie in memory, from the first one of the image on, in elements */
INLINE void offsets_of(const Job *job, Wholes x, Wholes y, int64_t *offsets) {
    const int64_t down = job->source_strides[2], across = job->source_strides[3];
    int i;
    if (down * job->source_height + across * job->source_width < INT32_MAX) {
        const Wholes at = y * (int32_t)down + x * (int32_t)across;
        for (i = 0; i < LANES; i++) offsets[i] = at[i];
    } else {
        for (i = 0; i < LANES; i++) offsets[i] = y[i] * down + x[i] * across;
    }
}

INLINE void bilinear_planes(const Span *span, Squares at, int type) {
    const Job *job = span->job;
    const int64_t bytes = size_of(type), below = job->source_strides[2];
    const int64_t from = job->source_strides[1] * bytes, to = job->result_strides[1] * bytes;
    const char *plane = span->source;
    char *result = span->result;
    int64_t offsets[LANES], c;
    offsets_of(job, at.x, at.y, offsets);
    for (c = 0; c < job->channels; c++, plane += from, result += to) {
        const Floats above = between_pairs(plane, offsets, at.u, type);
        const Floats under = between_pairs(plane + below * bytes, offsets, at.u, type);
        const Floats value = above * (1 - at.v) + under * at.v;
        ask_below(plane + offsets[0] * bytes, below * bytes);
        if (type == FLOAT32) store_floats(result, value, span->pixels);
        else if (type == UINT16) store_words(result, rounded_all(value), span->pixels);
        else store_bytes(result, type == BOOL ? truth(value) : rounded_all(value), span->pixels);
    }
}

/* -- pixels whose three or four channels are neighbours in memory, and then come those of the next pixel */

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

INLINE void bilinear_interleaved(const Span *span, Squares at, int type) {
    const Job *job = span->job;
    const int64_t bytes = size_of(type), channels = job->channels;
    const int64_t right = channels * bytes, below = job->source_strides[2] * bytes;
    float values[LANES * MOST_INTERLEAVED + 4];
    int64_t offsets[LANES], i, n = span->pixels * channels;
    offsets_of(job, at.x, at.y, offsets);
    ask_below(span->source + offsets[0] * bytes, below);
    ask_below(span->source + offsets[LANES - 1] * bytes, below);
    for (i = 0; i < LANES; i++) {
        const char *upper = span->source + offsets[i] * bytes, *lower = upper + below;
        const V4 u = every4(at.u[i]), v = every4(at.v[i]);
        const V4 above = channels4(upper, type) * (1 - u) + channels4(upper + right, type) * u;
        const V4 under = channels4(lower, type) * (1 - u) + channels4(lower + right, type) * u;
        const V4 value = above * (1 - v) + under * v;
        memcpy(values + i * channels, &value, sizeof value);
    }
    if (type == FLOAT32) {
        if (span->pixels == LANES && channels == 3) memcpy(span->result, values, 3 * LANES * sizeof(float));
        else memcpy(span->result, values, (size_t)n * sizeof(float));
    } else {
        for (i = 0; i < n; i += LANES) {
            const Wholes whole = type == BOOL ? truth(load_floats(values + i)) : rounded_all(load_floats(values + i));
            const int64_t left = n - i < LANES ? n - i : LANES;
            if (type == UINT16) store_words(span->result + 2 * i, whole, left);
            else store_bytes(span->result + i, whole, left);
        }
    }
}

/* -- pixels of one channel, sixteen neighbours each */

INLINE void cubic_weights_all(Floats t, Floats *w) {
    const Floats s = 1 - t;
    w[0] = -0.75f * t * s * s;
    w[1] = (1.25f * t - 2.25f) * t * t + 1;
    w[2] = (1.25f * s - 2.25f) * s * s + 1;
    w[3] = -0.75f * s * t * t;
}

/* Columns of a table */
INLINE void transpose(const V4 *rows, Floats *columns) {
    int i, k;
    for (k = 0; k < 4; k++)
        for (i = 0; i < LANES; i++) columns[k][i] = rows[i][k];
}

INLINE void bicubic_planes(const Span *span, Floats u, Floats v, int type) {
    const Job *job = span->job;
    const int64_t bytes = size_of(type), below = job->source_strides[2] * bytes;
    const Squares at = squares_of(job, u, v, 1);
    Floats across[4], down[4];
    int64_t offsets[LANES], c;
    int i;
    offsets_of(job, at.x, at.y, offsets);
    cubic_weights_all(at.u, across);
    cubic_weights_all(at.v, down);
    for (c = 0; c < job->channels; c++) {
        const char *plane = span->source + c * job->source_strides[1] * bytes;
        char *result = span->result + c * job->result_strides[1] * bytes;
        V4 rows[LANES];
        Floats columns[4], value;
        ask_below(plane + offsets[0] * bytes, below);
        for (i = 0; i < LANES; i++) {
            const char *row = plane + (offsets[i] - 1) * bytes - below;
            rows[i] = channels4(row, type) * every4(down[0][i]) + channels4(row + below, type) * every4(down[1][i]) +
                      channels4(row + 2 * below, type) * every4(down[2][i]) +
                      channels4(row + 3 * below, type) * every4(down[3][i]);
        }
        transpose(rows, columns);
        value = columns[0] * across[0] + columns[1] * across[1] + columns[2] * across[2] + columns[3] * across[3];
        if (type == FLOAT32) {
            if (!all_true((value >= every(-3.4028235e38f)) & (value <= every(3.4028235e38f))))
                for (i = 0; i < LANES; i++) {
                    const Taps taps = taps_at(job, u[i], v[i], BICUBIC);
                    value[i] = sample_at(job, plane, &taps, 0, FLOAT32, BICUBIC);
                }
            store_floats(result, value, span->pixels);
        } else if (type == BOOL) {
            store_bytes(result, truth(value), span->pixels);
        } else {
            value = clamped_all(value, type == UINT16 ? 65535 : 255);
            if (type == UINT16) store_words(result, rounded_all(value), span->pixels);
            else store_bytes(result, rounded_all(value), span->pixels);
        }
    }
}

INLINE void nearest_all(const Span *span, Floats u, Floats v, int type) {
    const Job *job = span->job;
    const Wholes x = rounded_all(u), y = rounded_all(v);
    int64_t offsets[LANES], c, i;
    offsets_of(job, x, y, offsets);
    for (c = 0; c < job->channels; c++) {
        const char *plane = span->source + c * job->source_strides[1] * size_of(type);
        char *result = span->result + c * job->result_strides[1] * size_of(type);
        ask_below(plane + offsets[0] * size_of(type), job->source_strides[2] * size_of(type));
        if (span->pixels == LANES && job->result_strides[3] == 1)
            for (i = 0; i < LANES; i++) move(result, i, plane, offsets[i], type);
        else
            for (i = 0; i < span->pixels; i++) move(result, i * job->result_strides[3], plane, offsets[i], type);
    }
}

/* Whether pixels lie beyond what zeros reach, or have no position */
INLINE int shows_nothing(const Job *job, Floats u, Floats v, int mode) {
    const float reach = job->padding != ZEROS ? INFINITY : reach_of(mode);
    const Floats low = every(-reach);
    const Floats right = every((float)(job->source_width - 1) + reach);
    const Floats below = every((float)(job->source_height - 1) + reach);
    return all_true(~((u >= low) & (u <= right) & (v >= low) & (v <= below)));
}

INLINE void group(const Span *span, const float *at_u, const float *at_v, int type, int mode, int layout) {
    const Job *job = span->job;
    const Floats u = load_floats(at_u), v = load_floats(at_v);
    int done = 0;
    if (mode == NEAREST) {
        if (inside(job, u, v, 0, 0)) {
            nearest_all(span, u, v, type);
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
        const Wholes in = (u >= every(0)) & (u <= every((float)(job->source_width - 2))) & (v >= every(0)) &
                      (v <= every((float)(job->source_height - 1)));
        if ((done = true_lanes(in))) {
            const Floats on_u = (Floats)((Wholes)u & in), on_v = (Floats)((Wholes)v & in);
            if (layout == PLANES) bilinear_planes(span, squares_of(job, on_u, on_v, 1), type);
            else bilinear_interleaved(span, squares_of(job, on_u, on_v, 2), type);
        }
    }
    careful(span, at_u, at_v, type, mode, (uint32_t)done);
}

#else

INLINE void group(const Span *span, const float *at_u, const float *at_v, int type, int mode, int layout) {
    (void)layout;
    careful(span, at_u, at_v, type, mode, 0);
}

#endif

/* Where images lie, of the kinds that ways of some types know, strides in elements */
typedef struct {
    const char *source;
    int64_t channels, from_plane, below, to_plane, width, height;
} Image;

/* Whether 16 bits hold all places of an image, and its rows at least eight bytes */
INLINE int is_small(const Image *image) {
    const int has_small_steps = image->below >= 0 && image->below < 32768;
    return has_small_steps && image->width >= 8 && image->width < 32767 && image->height < 32767;
}

/* Pixels i ... n - 1 of a row; `first`: where that at 0 is written */
INLINE void groups(Span *span, char *first, const Chunk *at, int64_t i, int64_t n, int type, int mode, int layout) {
    const int64_t step = span->job->result_strides[3] * size_of(type);
    for (; i < n; i += LANES) {
        span->result = first + i * step, span->pixels = n - i < LANES ? n - i : LANES;
        group(span, at->u + i, at->v + i, type, mode, layout);
    }
}
