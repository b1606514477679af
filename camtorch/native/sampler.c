/* Samples images where a warp says, in tiles of rows: one variant, for the instructions that it is compiled for.
 *
 * A tile goes by columns of chunks, STEP rows of which are made for one image after the other: first their positions, then
 * their pixels, by the widest way that knows them. What a way cannot make goes by the one before it in the list of headers.
 */
#include "sampler.h"

#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#include "unit.h"
#include "vectors.h"

#include "sampler_pixel.h"
#include "sampler_positions.h"
#include "sampler_floats.h"
#if defined(__AVX2__)
#include "sampler_bytes.h"
#elif NEON
#include "sampler_neon.h"
#endif
#if WIDE
#include "sampler_wide.h"
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
    while (i < n && shows_nothing(job, load_floats(at->u + i), load_floats(at->v + i), mode)) i += LANES;
    while (end > i && shows_nothing(job, load_floats(at->u + end - LANES), load_floats(at->v + end - LANES), mode)) end -= LANES;
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
#if defined(__AVX2__) || NEON
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
    groups(span, first, at, i, n, type, mode, layout);
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
    static NOT_INLINE void NAME(type, mode, layout)(const Job *job, const Chunk *at, int64_t b, int64_t y,             \
                                                    int64_t count, int64_t x, int64_t n) {                             \
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
