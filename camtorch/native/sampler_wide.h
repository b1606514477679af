/* Up to 32 pixels at a time, with AVX-512, whose neighbours are picked out of whole registers: of floats, bytes, and what is
 * moved.
 */

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
static NOT_INLINE int around(const Job *job, const Image *image, char *result, const float *u, const float *v, int pixel,
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
                groups(span, first, at, i, i + 16, FLOAT32, BILINEAR, PLANES);
        return i;
    }
    if (mode == NEAREST && type == BYTES4 && in_planes && llabs(image.below) * image.height + image.width < INT32_MAX) {
        for (; n - i >= 16; i += 16)
            if (!nearest_of_sixteen(&image, first + 4 * i, at->u + i, at->v + i))
                groups(span, first, at, i, i + 16, BYTES4, NEAREST, SCATTERED);
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
