/* Bytes in fixed point, sixteen or eight pixels at a time, with AVX2: positions in 2^-16 of a pixel, results in 2^-8 of a grey
 * level.
 */

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
INLINE Wholes begins(const float *x, int64_t last) {
#define TWO(i) _mm_unpacklo_ps(_mm_loadu_ps(x + STEP * (i)), _mm_loadu_ps(x + STEP * ((i) + 1)))
    const __m256 first = _mm256_set_m128(_mm_movelh_ps(TWO(4), TWO(6)), _mm_movelh_ps(TWO(0), TWO(2)));
#undef TWO
    const __m256 turned = _mm256_permutevar8x32_ps(first, _mm256_setr_epi32(1, 2, 3, 4, 5, 6, 7, 0));
    const __m256 next = _mm256_blend_ps(turned, _mm256_broadcast_ss(x + STEP * STEP), 0x80);
    const __m256 least = _mm256_sub_ps(_mm256_min_ps(next, first), _mm256_set1_ps(1 / 64.0f));
    return truncated((Floats)_mm256_max_ps(_mm256_min_ps(least, _mm256_set1_ps((float)last)), _mm256_setzero_ps()));
}

static NOT_INLINE void windows_of(const Image *image, const Chunk *at, int64_t i, int64_t n, Windows *windows) {
    int64_t j;
    for (j = i / STEP / STEP * STEP; j < n / STEP; j += STEP) {
        const Wholes x = begins(at->u + STEP * j, image->width - 16);
        const Wholes y = begins(at->v + STEP * j, image->height - FIVE_ROWS);
        const Wholes begin = y * (int32_t)image->below + x;
        const Floats from_u = 128 - as_floats(x), from_v = 128 - as_floats(y);
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

static NOT_INLINE int64_t sixteens_of(const Image *image, const Windows *windows, char *first, const Chunk *at, int64_t i,
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

static NOT_INLINE int64_t eights_of(const Image *image, char *first, const Chunk *at, int64_t i, int64_t n, int pixel) {
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

static NOT_INLINE void anywhere(const Job *job, const Image *image, char *result, const float *u, const float *v, int pixel) {
    if (pixel == 1) any_sixteen(job, image, result, u, v);
    else if (pixel == 3) any_eight(job, image, result, u, v, 3);
    else any_eight(job, image, result, u, v, 4);
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
    if (mode == NEAREST) groups(span, first, at, i, n, BYTES1, NEAREST, SCATTERED);
    else groups(span, first, at, i, n, UINT8, BILINEAR, pixel == 1 ? PLANES : INTERLEAVED);
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
