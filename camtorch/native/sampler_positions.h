/* Where the pixels of a row are read: between the nodes of a lattice, or as a grid says. Nothing is read here. */

enum { CHUNK = 256 }; /* pixels of a row whose positions are made at a time */

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
static NOT_INLINE void lay_line(const float *nodes, int64_t cells, float side, float *__restrict line) {
    const float half = side / 2, middle = (side - 1) / 2;
    int64_t j;
    for (j = 0; j < cells; j++, nodes++, line += STEP) {
        const float a = nodes[0] * half, b = nodes[1] * half, c = nodes[2] * half, d = nodes[3] * half;
#if VECTORS
        for (int k = 0; k < STEP; k += LANES) {
#define ALL(row) load_floats(WEIGHTS[row] + k)
            const Floats made = ALL(0) * a + ALL(1) * b + ALL(2) * c + ALL(3) * d + middle;
#undef ALL
            memcpy(line + k, &made, sizeof made);
        }
#else
        int k;
        for (k = 0; k < STEP; k++)
            line[k] = WEIGHTS[0][k] * a + WEIGHTS[1][k] * b + WEIGHTS[2][k] * c + WEIGHTS[3][k] * d + middle;
#endif
    }
}

/* Those between four lines, at `part` / 8 from the second to the third one */
static NOT_INLINE void between_lines(const float (*lines)[CHUNK], int64_t row, int part, int64_t n, float *__restrict to) {
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

#if VECTORS

/* Brings positions of n pixels along one axis onto the image, as the padding reads it; NaN stays */
static NOT_INLINE void pad(const float *x, float *to, int64_t n, int64_t side, int padding, int type) {
    /* the last pixel belongs to the square before it, as bytes are interpolated */
    const float end = (float)(side - 1), last = type == UINT8 ? end - greater(end, 128) * 1.2e-7f : end;
    const Floats far = every(2097152.0f);
    int64_t i;
    int k;
    for (i = 0; i < n; i += LANES) {
        Floats at = load_floats(x + i);
        if (padding == REFLECTION && !all_true((at >= every(0)) & (at <= every(end)))) {
            if (all_true((at > -far) & (at < far))) at = reflected_all(at, (float)side);
            else
                for (k = 0; k < LANES; k++) at[k] = at[k] == at[k] ? reflected(at[k], (float)side) : at[k];
        }
        at = clamped_all(at, greater(last, 0));
        memcpy(to + i, &at, sizeof at);
    }
    to[i] = to[i - 1];
}

#endif
