/* Random jobs for every variant of the sampler: built with sanitizers, it shows that none reads or writes outside, and
 * that all agree with the one that has no vectors. Memory is as large as what is addressed, to the byte.
 *
 * Called as: sampler_fuzz FIRST COUNT, the numbers of the jobs. Ends with 1, and the job's number, where two disagree.
 */
#include <math.h>
#include <string.h>

#include "chance.h"
#include "sampler.h"

typedef struct {
    const char *name;
    void (*sample)(Job *);
    void (*classify)(const Classification *);
    void (*lay)(Laying *);
} Variant;

#define DECLARED(variant)                                                                                              \
    void sample_##variant(Job *);                                                                                      \
    void classify_##variant(const Classification *);                                                                   \
    void lay_##variant(Laying *);
#define LISTED(variant) {#variant, sample_##variant, classify_##variant, lay_##variant}
DECLARED(plain)
#ifdef HAS_BASELINE
DECLARED(baseline)
#endif
#ifdef HAS_AVX2
DECLARED(avx2)
#endif
#ifdef HAS_AVX512
DECLARED(avx512)
#endif

static int variants(Variant *all) {
    int n = 0;
    all[n++] = (Variant)LISTED(plain);
#ifdef HAS_BASELINE
    all[n++] = (Variant)LISTED(baseline);
#endif
#ifdef HAS_AVX2
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2"))
        all[n++] = (Variant)LISTED(avx2);
#endif
#ifdef HAS_AVX512
    if (__builtin_cpu_supports("avx512vbmi") && __builtin_cpu_supports("avx512vl") &&
        __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq"))
        all[n++] = (Variant)LISTED(avx512);
#endif
    return n;
}

static int one_in(int64_t n) { return below(n) == 0; }
static double uniform(double low, double high) { return low + (high - low) * share(); }

static int64_t side(void) {
    switch (below(8)) {
    case 0: return 1;
    case 1: return 2;
    case 2: return 1 + below(4);
    case 3: return 8 * (1 + below(6));
    case 4: return one_in(40) ? 2000 + below(18001) : 1 + below(400);
    default: return 1 + below(150);
    }
}

/* -- memory */

static const int SIZES[TYPES] = {1, 1, 2, 4, 1, 2, 4, 8};

static void *allocated(int64_t bytes) {
    void *memory = malloc((size_t)bytes);
    if (!memory) exit(2);
    return memory;
}

/* Strides in elements of an image (b, c, y, x), shared ones if that is allowed, and how many elements they reach */
static int64_t drawn_strides(const int64_t *shape, int64_t *strides, int may_share) {
    static const int ORDERS[5][4] = {{3, 2, 1, 0}, {1, 3, 2, 0}, {2, 3, 1, 0}, {3, 1, 2, 0}, {0, 1, 2, 3}};
    const int *order = ORDERS[below(3) ? below(2) : below(5)];
    int64_t next = 1, reach = 1;
    int k, gaps = one_in(3);
    for (k = 0; k < 4; k++) {
        const int dim = order[k];
        strides[dim] = next;
        /* what is cropped leaves gaps, most of them between rows */
        next *= shape[dim] + (gaps && (dim == 3 || one_in(3)) ? below(9) : 0);
        if (may_share && one_in(12)) strides[dim] = 0;
        if (shape[dim] == 1 && one_in(3)) strides[dim] = below(1000);
    }
    for (k = 0; k < 4; k++) reach += (shape[k] - 1) * strides[k];
    return reach;
}

/* -- positions as of grid_sample */

typedef struct {
    double first[2], right[2], down[2], noise;
    int strange, corners;
} Field;

static Field drawn_field(const Job *job) {
    const double sides[2] = {(double)job->source_width, (double)job->source_height};
    const double turn = one_in(2) ? uniform(-0.1, 0.1) : uniform(-3.2, 3.2), zoom = exp(uniform(-2, 1.5));
    Field field;
    int k;
    for (k = 0; k < 2; k++) {
        field.right[k] = 2 * zoom * (k ? sin(turn) : cos(turn)) / sides[k];
        field.down[k] = 2 * zoom * (k ? cos(turn) : -sin(turn)) / sides[k];
        /* the middle of the target near that of the source */
        field.first[k] = uniform(-0.5, 0.5) - (double)job->width / 2 * field.right[k] -
                         (double)job->height / 2 * field.down[k];
        if (one_in(3)) /* exactly the pixels, and one of them at a corner */
            field.right[k] = k ? 0 : 2 / sides[0], field.down[k] = k ? 2 / sides[1] : 0,
            field.first[k] = 1 / sides[k] - 1 + (one_in(2) ? 0 : 2 * (double)below(3) / sides[k]) + (one_in(3) ? 1 / sides[k] : 0);
    }
    field.noise = one_in(3) ? exp(uniform(-12, 1)) : 0;
    field.strange = one_in(3) ? 1 + (int)below(200) : 0;
    field.corners = one_in(6);
    return field;
}

static double strange(int64_t n) {
    static const double VALUES[] = {NAN,  INFINITY, -INFINITY, 1e30, -1e30, 3.4e38, -3.4e38, 1, -1, 0, -0.0, 1e-40,
                                    -9,   100,      -100,      1e5,  1e9,   -1e9,   1 - 0x1p-24, -1 + 0x1p-24, 2147483647.0};
    const double edge = 1 - 1 / (double)n;
    if (one_in(3)) return (one_in(2) ? edge : -edge) + (double)(below(5) - 2) * (one_in(2) ? 0x1p-24 : 1 / (double)n);
    return VALUES[below(sizeof VALUES / sizeof *VALUES)];
}

static double position(const Field *field, const Job *job, int k, double x, double y) {
    double value = field->first[k] + field->right[k] * x + field->down[k] * y;
    if (field->corners) {
        /* the last pixels that may be read at once, and exactly so; in rows, and all of a row that lie in it */
        const int64_t n = k ? job->source_height : job->source_width, last = k ? (int64_t)y % 4 : below(one_in(8) ? 6 : 3);
        return (2 * (double)(n - last) - 1) / (double)n - 1;
    }
    if (field->noise) value += uniform(-field->noise, field->noise);
    if (field->strange && one_in(field->strange)) value = strange(k ? job->source_height : job->source_width);
    return value;
}

/* -- a job */

typedef struct {
    Job job;
    int64_t source_reach, result_reach;
    char *result; /* as it was before */
} Drawn;

static void draw_source(Job *job, int64_t reach) {
    const int64_t bytes = reach * SIZES[job->type];
    char *source = allocated(bytes);
    int64_t i;
    for (i = 0; i < bytes; i++) source[i] = (char)bits();
    if (job->type == BOOL)
        for (i = 0; i < bytes; i++) source[i] &= 1;
    if (job->type == FLOAT32)
        for (i = 0; i < reach; i++) ((float *)source)[i] = (float)uniform(-1, 1);
    job->source = source;
}

static void draw_grid(Job *job) {
    const Field field = drawn_field(job);
    const int shared = one_in(2);
    const int64_t count = shared ? 1 : job->count, area = job->height * job->width;
    int64_t *s = job->grid_strides, reach, b, x, y;
    char *grid;
    int k;
    job->grid_is_double = one_in(4);
    switch (below(4)) {
    case 0: s[3] = area, s[2] = 1, s[1] = job->width, s[0] = 2 * area; break;
    case 1: s[3] = 1, s[2] = 2 * job->height, s[1] = 2, s[0] = 2 * area; break;
    case 2: s[3] = 3, s[2] = 7, s[1] = 7 * job->width + 5, s[0] = s[1] * job->height; break;
    default: s[3] = 1, s[2] = 2, s[1] = 2 * job->width, s[0] = 2 * area;
    }
    if (shared) s[0] = 0;
    if (one_in(20)) s[1] = 0;
    if (one_in(20)) s[2] = 0;
    reach = (count - 1) * s[0] + (job->height - 1) * s[1] + (job->width - 1) * s[2] + s[3] + 1;
    grid = allocated(reach * (job->grid_is_double ? 8 : 4));
    for (b = 0; b < count; b++)
        for (y = 0; y < job->height; y++)
            for (x = 0; x < job->width; x++)
                for (k = 0; k < 2; k++) {
                    const int64_t at = b * s[0] + y * s[1] + x * s[2] + k * s[3];
                    const double value = position(&field, job, k, (double)x, (double)y);
                    if (job->grid_is_double) ((double *)grid)[at] = value;
                    else ((float *)grid)[at] = (float)value;
                }
    job->grid = grid;
    if (one_in(3)) {
        uint8_t *mapped = allocated(count * area);
        for (b = 0; b < count * area; b++) mapped[b] = !one_in(7);
        job->mapped = mapped, job->mapped_stride = shared ? 0 : area;
    }
}

static void draw_lattice(Job *job) {
    const Field field = drawn_field(job);
    const int shared = one_in(2);
    const int64_t rows = (job->height + STEP - 1) / STEP, columns = (job->width + STEP - 1) / STEP;
    const int64_t count = shared ? 1 : job->count, area = (rows + 5) * (columns + 5), exact = 1 + below(5);
    const int64_t gap = one_in(3) ? below(50) : 0;
    float *nodes = allocated(count * 2 * (area + gap) * 4), *positions = allocated(2 * exact * STEP * STEP * 4);
    int32_t *cells = allocated(count * rows * columns * 4);
    const int kinds = (int)below(4);
    int64_t b, i, j;
    int k;
    for (b = 0; b < count; b++)
        for (k = 0; k < 2; k++)
            for (i = 0; i < rows + 5; i++)
                for (j = 0; j < columns + 5; j++)
                    nodes[(b * 2 + k) * (area + gap) + i * (columns + 5) + j] =
                        (float)position(&field, job, k, (double)(STEP * (j - 2)), (double)(STEP * (i - 2)));
    for (i = 0; i < count * rows * columns; i++)
        cells[i] = kinds == 0 || !one_in(4) ? CELL_CUBIC : one_in(3) ? CELL_EMPTY : (int32_t)below(exact);
    for (k = 0; k < 2; k++)
        for (i = 0; i < exact * STEP * STEP; i++) {
            positions[k * exact * STEP * STEP + i] =
                (float)position(&field, job, k, (double)(i % STEP), (double)(i / STEP % STEP));
            if (one_in(50)) positions[i] = NAN;
        }
    job->nodes = nodes, job->cells = cells, job->exact = positions, job->exact_stride = exact * STEP * STEP;
    job->node_strides[0] = shared ? 0 : 2 * (area + gap), job->node_strides[1] = area + gap;
    job->cell_stride = shared ? 0 : rows * columns, job->rows = rows, job->columns = columns;
}

static Drawn drawn(void) {
    Drawn all;
    Job *job = &all.job;
    int64_t shape[4];
    float *fill;
    char *elements;
    int64_t c;
    memset(&all, 0, sizeof all);
    job->count = one_in(3) ? 1 + below(3) : 1;
    job->channels = one_in(10) ? 5 + below(4) : 1 + below(4);
    job->source_height = side(), job->source_width = side();
    job->height = side(), job->width = side();
    if (job->height * job->width > 20000 && !one_in(20)) job->height = 1 + below(8);
    job->mode = (int32_t)below(3), job->padding = (int32_t)below(3);
    job->type = job->mode == NEAREST ? BYTES1 + (int32_t)below(4) : (int32_t)below(4);
    job->tile_rows = 8 * (1 + (int32_t)below(4));
    shape[0] = job->count, shape[1] = job->channels, shape[2] = job->source_height, shape[3] = job->source_width;
    all.source_reach = drawn_strides(shape, job->source_strides, 1);
    shape[2] = job->height, shape[3] = job->width;
    all.result_reach = drawn_strides(shape, job->result_strides, 0);
    draw_source(job, all.source_reach);
    fill = allocated(job->channels * 4), elements = allocated(job->channels * SIZES[job->type]);
    for (c = 0; c < job->channels; c++) {
        const int value = one_in(2) ? 0 : (int)below(2);
        fill[c] = (float)value;
        memset(elements + c * SIZES[job->type], 0, (size_t)SIZES[job->type]);
        if (job->type == FLOAT32) ((float *)elements)[c] = fill[c];
        else if (job->type == UINT16) ((uint16_t *)elements)[c] = (uint16_t)value;
        else elements[c * SIZES[job->type]] = (char)value;
    }
    job->fill = fill, job->fill_elements = elements;
    if (one_in(2)) draw_grid(job);
    else draw_lattice(job);
    all.result = allocated(all.result_reach * SIZES[job->type]);
    for (c = 0; c < all.result_reach * SIZES[job->type]; c++) all.result[c] = (char)bits();
    return all;
}

static void release(Drawn *all) {
    Job *job = &all->job;
    const void *owned[] = {job->source, job->fill, job->fill_elements, job->grid, job->mapped,
                           job->nodes,  job->cells, job->exact, all->result};
    size_t i;
    for (i = 0; i < sizeof owned / sizeof *owned; i++) free((void *)owned[i]);
}

static char *made(const Drawn *all, const Variant *variant) {
    const int64_t bytes = all->result_reach * SIZES[all->job.type];
    Job job = all->job;
    char *result = allocated(bytes);
    memcpy(result, all->result, (size_t)bytes);
    job.result = result, job.next = 0;
    variant->sample(&job);
    return result;
}

/* -- what is asked of results */

/* Where a pixel is to be read, in pixels of the source, without the roundings of single precision */
static void where(const Job *job, int64_t b, int64_t y, int64_t x, double *at) {
    const double sides[2] = {(double)job->source_width, (double)job->source_height};
    int k, i, j;
    for (k = 0; k < 2; k++) {
        double value = 0;
        if (job->grid) {
            const int64_t i = b * job->grid_strides[0] + y * job->grid_strides[1] + x * job->grid_strides[2] +
                              k * job->grid_strides[3];
            value = job->grid_is_double ? ((const double *)job->grid)[i] : ((const float *)job->grid)[i];
            if (job->mapped && !job->mapped[b * job->mapped_stride + y * job->width + x]) value = NAN;
        } else {
            const int32_t cell = job->cells[b * job->cell_stride + y / STEP * job->columns + x / STEP];
            if (cell == CELL_EMPTY) value = NAN;
            else if (cell >= 0)
                value = job->exact[k * job->exact_stride + cell * STEP * STEP + y % STEP * STEP + x % STEP];
            else
                for (i = 0; i < 4; i++)
                    for (j = 0; j < 4; j++) {
                        const double part[2] = {(double)(y % STEP) / STEP, (double)(x % STEP) / STEP};
                        double weight = 1;
                        int axis, other;
                        for (axis = 0; axis < 2; axis++)
                            for (other = -1; other < 3; other++)
                                if (other != (axis ? j : i) - 1)
                                    weight *= (part[axis] - other) / ((axis ? j : i) - 1 - other);
                        value += weight * job->nodes[b * job->node_strides[0] + k * job->node_strides[1] +
                                                     (y / STEP + 1 + i) * (job->columns + 5) + x / STEP + 1 + j];
                    }
        }
        at[k] = ((value + 1) * sides[k] - 1) / 2;
    }
}

static double value_of(const char *plane, int64_t at, int type) {
    switch (type) {
    case UINT16: return ((const uint16_t *)plane)[at];
    case FLOAT32: return ((const float *)plane)[at];
    default: return ((const uint8_t *)plane)[at];
    }
}

/* 0 where pixels are written that are none of the result's, or differ by more than rounding does */
static int agree(const Drawn *all, const char *given, const char *expected, double *largest) {
    const Job *job = &all->job;
    const int bytes = SIZES[job->type];
    const double range = job->type == UINT8 ? 255 : job->type == UINT16 ? 65535 : job->type == FLOAT32 ? 2 : 1;
    char *touched = calloc((size_t)all->result_reach, 1);
    int64_t b, c, y, x, i;
    int k, good = 1;
    for (b = 0; b < job->count; b++)
        for (y = 0; y < job->height; y++)
            for (x = 0; x < job->width; x++) {
                double at[2], lost = 0, away = 1;
                where(job, b, y, x, at);
                for (k = 0; k < 2; k++) {
                    const double n = (double)(k ? job->source_height : job->source_width);
                    const double error = 8 * 0x1p-23 * (fabs(at[k]) + n);
                    lost = fmax(lost, error);
                    away = fmin(away, fabs(at[k] - floor(at[k]) - 0.5) - error);
                }
                for (c = 0; c < job->channels; c++) {
                    const int64_t to = b * job->result_strides[0] + c * job->result_strides[1] +
                                       y * job->result_strides[2] + x * job->result_strides[3];
                    touched[to] = 1;
                    /* beyond, one rounding decides which pixel is read */
                    if (!(lost < 0.05) && (at[0] == at[0] && at[1] == at[1])) continue;
                    if (job->mode == NEAREST) {
                        if (away < 0 && (at[0] == at[0] && at[1] == at[1])) continue;
                        if (memcmp(given + to * bytes, expected + to * bytes, (size_t)bytes)) good = 0;
                    } else if (job->type == BOOL) {
                        if (given[to] != 0 && given[to] != 1) good = 0;
                    } else {
                        const double difference =
                            fabs(value_of(given, to, job->type) - value_of(expected, to, job->type)) / range;
                        const double step = job->type == FLOAT32 ? 0 : 1.001 / range;
                        if (!(difference <= 1e-5 + step + (at[0] == at[0] && at[1] == at[1] ? 4 * lost : 0))) good = 0;
                        if (job->type == FLOAT32 && lost < 1e-4 && difference > *largest) *largest = difference;
                    }
                    if (!good) {
                        fprintf(stderr, "image %lld channel %lld row %lld column %lld at (%.9g, %.9g): %g instead of %g\n",
                                (long long)b, (long long)c, (long long)y, (long long)x, at[0], at[1],
                                value_of(given, to, job->type), value_of(expected, to, job->type));
                        free(touched);
                        return 0;
                    }
                }
            }
    for (i = 0; i < all->result_reach; i++)
        if (!touched[i] && memcmp(given + i * bytes, all->result + i * bytes, (size_t)bytes)) {
            fprintf(stderr, "element %lld is written, and no pixel\n", (long long)i);
            good = 0;
            break;
        }
    free(touched);
    return good;
}

static void classify_any(const Variant *all, int n) {
    Classification given;
    Job job;
    Field field;
    float *nodes;
    uint8_t *mapped, *rim;
    int64_t b, i, j, width, area, rim_size;
    int k;
    memset(&given, 0, sizeof given);
    memset(&job, 0, sizeof job);
    given.count = 1 + below(3), given.height = side(), given.width = side();
    given.rows = (given.height + STEP - 1) / STEP, given.columns = (given.width + STEP - 1) / STEP;
    job.height = given.height, job.width = given.width, job.source_height = side(), job.source_width = side();
    given.source_height = (double)job.source_height, given.source_width = (double)job.source_width;
    given.padding = (int32_t)below(3);
    given.tolerance = one_in(9) ? 1e30 : exp(uniform(-9, 1));
    width = given.columns + 5, area = (given.rows + 5) * width, rim_size = 2 * (given.height + given.width);
    nodes = allocated(given.count * 2 * area * 4);
    mapped = allocated(given.count * area), rim = allocated(given.count * rim_size);
    field = drawn_field(&job);
    for (b = 0; b < given.count; b++)
        for (k = 0; k < 2; k++)
            for (i = 0; i < given.rows + 5; i++)
                for (j = 0; j < width; j++)
                    nodes[(b * 2 + k) * area + i * width + j] =
                        (float)position(&field, &job, k, (double)(STEP * (j - 2)), (double)(STEP * (i - 2)));
    k = one_in(2) ? 1 + (int)below(50) : 0;
    for (i = 0; i < given.count * area; i++) mapped[i] = !(k && one_in(k));
    for (i = 0; i < given.count * rim_size; i++) rim[i] = !(k && one_in(k));
    given.nodes = nodes, given.node_strides[0] = 2 * area, given.node_strides[1] = area;
    given.mapped = mapped, given.mapped_stride = area, given.rim = rim, given.rim_stride = rim_size;
    for (k = 0; k < n; k++) {
        given.cells = allocated(given.count * given.rows * given.columns * 4);
        given.scratch = allocated(25 * (given.columns + 8) * 4);
        all[k].classify(&given);
        for (i = 0; i < given.count * given.rows * given.columns; i++)
            if (given.cells[i] != CELL_EMPTY && given.cells[i] != CELL_CUBIC && given.cells[i] != CELL_DOUBT && given.cells[i])
                abort();
        free(given.cells), free(given.scratch);
    }
    free(nodes), free(mapped), free(rim);
}

static float *uniform_floats(int64_t count) {
    float *made = allocated(count * 4);
    for (int64_t i = 0; i < count; i++) made[i] = (float)uniform(-2, 2);
    return made;
}

static double product(const float *a, const float *b, int64_t count) {
    double sum = 0;
    for (int64_t i = 0; i < count; i++) sum += a[i] == a[i] ? (double)a[i] * b[i] : 0;
    return sum;
}

static int are_near(const float *a, const float *b, int64_t count, double by) {
    int good = 1;
    for (int64_t i = 0; i < count; i++) good &= fabs((double)a[i] - b[i]) <= by;
    return good;
}

/* Lays a lattice, and gathers gradients: the number of the variant that differs from plain, or whose gradients are not the
 * transpose of its positions; -1 if all are fine */
static int lay_any(const Variant *all, int n) {
    Laying given;
    memset(&given, 0, sizeof given);
    given.count = 1 + below(2), given.height = side(), given.width = side();
    if (given.height * given.width > 5000 && !one_in(20)) given.height = 1 + below(20), given.width = 1 + below(700);
    given.rows = (given.height + STEP - 1) / STEP, given.columns = (given.width + STEP - 1) / STEP;
    const int64_t cells = given.count * given.rows * given.columns, pixels = given.count * given.height * given.width;
    const int64_t nodes = 2 * given.count * (given.rows + 5) * (given.columns + 5);
    const int usual = one_in(2) ? CELL_QUINTIC : CELL_CUBIC, rare = CELL_QUINTIC + CELL_CUBIC - usual;
    const int64_t others = one_in(3) ? 0 : 1 + below(30);
    int32_t *kinds = allocated(cells * 4);
    for (int64_t i = 0; i < cells; i++) {
        const int is_other = others && one_in(others);
        kinds[i] = !is_other ? usual : one_in(3) ? rare : one_in(2) ? CELL_EMPTY : (int32_t)given.exact_count++;
    }
    const int64_t exact = 2 * given.exact_count * STEP * STEP;
    float *from = uniform_floats(nodes), *from_exact = uniform_floats(exact), *weights = uniform_floats(2 * pixels);
    for (int64_t i = 0; i < exact / 2; i++)
        if (one_in(50)) from_exact[i] = from_exact[i + exact / 2] = NAN;
    float *first[3] = {NULL, NULL, NULL};
    int wrong = -1;
    given.cells = kinds;
    for (int k = 0; k < n && wrong < 0; k++) {
        float *made[3] = {uniform_floats(2 * pixels), calloc((size_t)nodes, 4), calloc((size_t)exact + 1, 4)};
        uint8_t *mapped = allocated(pixels);
        given.nodes = from, given.exact = from_exact, given.grid = made[0], given.mapped = mapped;
        given.is_transposed = 0, given.next = 0;
        all[k].lay(&given);
        given.nodes = made[1], given.exact = made[2], given.grid = weights, given.mapped = NULL;
        given.is_transposed = 1, given.next = 0;
        all[k].lay(&given);
        double laid = 0;
        for (int64_t i = 0; i < pixels; i++) laid += mapped[i] ? product(made[0] + 2 * i, weights + 2 * i, 2) : 0;
        const double back = product(from, made[1], nodes) + product(from_exact, made[2], exact);
        const int64_t counts[3] = {2 * pixels, nodes, exact};
        if (!(fabs(laid - back) <= 1e-5 * (double)(pixels + 100))) wrong = k;
        for (int j = 0; j < 3; j++) {
            if (!k) first[j] = made[j];
            else if (!are_near(made[j], first[j], counts[j], j ? 1e-4 : 1e-5)) wrong = k;
            if (k) free(made[j]);
        }
        free(mapped);
    }
    for (int j = 0; j < 3; j++) free(first[j]);
    free(kinds), free(from), free(from_exact), free(weights);
    return wrong;
}

int main(int argc, char **argv) {
    Variant all[8];
    const int n = variants(all);
    double largest[8] = {0};
    int64_t first = argc > 1 ? atoll(argv[1]) : 0, count = argc > 2 ? atoll(argv[2]) : 1000, i;
    int k;
    for (i = first; i < first + count; i++) {
        Drawn drawing;
        char *expected = NULL;
        state = (uint64_t)i;
        drawing = drawn();
        for (k = 0; k < n; k++) {
            char *result = made(&drawing, all + k);
            if (k == 0) expected = result;
            if (!agree(&drawing, result, expected, largest + k)) {
                const Job *j = &drawing.job;
                fprintf(stderr,
                        "job %lld: %s and plain differ: type %d, mode %d, padding %d, %lld x %lld x %lld x %lld to %lld x %lld\n",
                        (long long)i, all[k].name, j->type, j->mode, j->padding, (long long)j->count,
                        (long long)j->channels, (long long)j->source_height, (long long)j->source_width,
                        (long long)j->height, (long long)j->width);
                return 1;
            }
            if (k) free(result);
        }
        free(expected);
        release(&drawing);
        classify_any(all, n);
        if ((k = lay_any(all, n)) >= 0) {
            fprintf(stderr, "job %lld: %s lays another lattice, or gathers other gradients\n", (long long)i, all[k].name);
            return 1;
        }
    }
    for (k = 1; k < n; k++) printf("%s %.2g\n", all[k].name, largest[k]);
    return 0;
}
