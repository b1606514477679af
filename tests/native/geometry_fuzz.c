/* Random cameras and rows for every variant of the geometry: built with sanitizers, it shows that none reads or writes
 * outside, and that results are finite. Memory is as large as what is addressed, to the byte.
 * See `all_jobs`.
 */
#include <math.h>
#include <string.h>

#include "chance.h"
#include "geometry.h"

int64_t geometry_fuzzed(const Rows *);
int64_t moves_fuzzed(const Move *);
int64_t lattices_fuzzed(const Lattices *);
void domain_fuzzed(const Domain *);

/* Numbers of that size, some of them wild */
static double number(double size) {
    static const double wild[] = {0, -0.0, NAN, INFINITY, -INFINITY, 1e30, -1e30, 1e-30, 1e-300, 1e300, -1e300};
    return below(20) ? size * (2 * share() - 1) : wild[below(11)];
}

static void *filled(int is_double, int64_t count, double size, double middle) {
    const int64_t bytes = count * (is_double ? 8 : 4);
    char *made = malloc((size_t)bytes + (bytes == 0));
    for (int64_t i = 0; i < count; i++) {
        if (is_double) ((double *)made)[i] = middle + number(size);
        else ((float *)made)[i] = (float)(middle + number(size));
    }
    return made;
}

/* Rows of three dims, with strides in any order and with gaps; the memory begins at the first */
static void *rows_of(int is_double, int64_t cameras, int64_t count, int64_t size, int64_t *strides, double middle) {
    static const int orders[4][3] = {{0, 1, 2}, {2, 0, 1}, {0, 2, 1}, {1, 0, 2}};
    const int64_t sides[3] = {cameras, count, size};
    const int *order = orders[below(4)];
    int64_t step = 1 + below(3) / 2, length = 1;
    for (int i = 2; i >= 0; i--) {
        strides[order[i]] = step;
        length += (sides[order[i]] - 1) * step;
        step *= sides[order[i]] + below(2);
    }
    return filled(is_double, length, 400, middle);
}

static int32_t factor_of(Part *part, int first, int last) {
    part->factor = first + (int32_t)below(last - first + 1);
    part->n = 1 + (int32_t)below(part->factor == RADIUS_TABLE ? 40 : 7);
    part->m = part->factor == RATIONAL ? 1 + (int32_t)below(4) : 0;
    return part->n * (part->factor == RADIUS_TABLE ? 4 : 1) + part->m;
}

static int64_t sampled; /* how many images lattices were handed on for */

void sample_images_fuzzed(const Images *given) {
    for (int64_t i = 0; i < given->count; i++) sampled += given->image >= 0 && given->image < given->jobs[i].count;
}

/* In the place of the one that lattice.c has, which has a fuzz of its own: cells of any kind */
int32_t classify_fuzzed(const Classification *given) {
    int32_t todo = 0;
    for (int64_t i = 0; i < given->rows * given->columns; i++) {
        const int32_t kinds[4] = {CELL_DOUBT, CELL_EMPTY, CELL_CUBIC, 0};
        given->cells[i] = kinds[below(4)];
        todo += given->cells[i] == 0;
    }
    given->scratch[SCRATCH * (given->columns + 8) - 1] = given->nodes[given->node_strides[1]];
    return todo;
}

/* Pixels, and a lattice, of cameras to themselves, some turned */
static int moved(const Cameras *cameras, int64_t tile) {
    const int d = (int)cameras->is_double, fits = below(2);
    const int64_t c = cameras->cameras, height = 1 + below(70), width = 1 + below(90);
    const int64_t rows = (height + 7) / 8, columns = (width + 7) / 8, nodes = (rows + 5) * (columns + 5);
    const int64_t n = fits ? nodes + 2 * (height + width) : 1 + below(700), size = d ? 8 : 4;
    int fine = 1;
    Move move = {0};
    void *turns = filled(d, 9 * c, 1, 0), *narrow = NULL, *valid = malloc((size_t)(c * n));
    int64_t following = 0, used = 0;
    move.from = move.to = cameras, move.cameras = c, move.form = fits ? POSITIONS : below(4);
    const int wide = move.form == BOXES ? 4 : 2;
    if (below(2)) {
        const int64_t back = below(2);
        move.turns = turns, move.turn_strides[0] = 9 * below(2);
        move.turn_strides[1] = back ? 1 : 3, move.turn_strides[2] = back ? 3 : 1;
    }
    move.height = 1 + (double)below(500), move.width = 1 + (double)below(500);
    void *pixels = wide > 2 ? filled(d, 4 * c * n, 300, 0) : rows_of(d, c, n, 2, move.row_strides, 300), *results;
    if (wide > 2) {
        move.row_strides[0] = move.result_strides[0] = 4 * n;
        move.row_strides[1] = move.result_strides[1] = 4, move.row_strides[2] = move.result_strides[2] = 1;
    }
    move.rows = pixels, move.count = n, move.tile = tile, move.valid = valid;
    move.next = below(2) ? &following : NULL;
    if (fits) {
        move.result_strides[0] = 2 * n, move.result_strides[1] = 1, move.result_strides[2] = n;
        results = malloc((size_t)(2 * c * n * size));
    } else results = wide > 2 ? malloc((size_t)(4 * c * n * size)) : rows_of(d, c, n, 2, move.result_strides, 0);
    move.results = results;
    if (!fits) moves_fuzzed(&move);
    else {
        int32_t *cells = malloc((size_t)(c * rows * columns) * sizeof *cells);
        float *scratch = malloc((size_t)(c * SCRATCH * (columns + 8)) * sizeof *scratch);
        void *exact = malloc((size_t)(2 * c * rows * columns * 64 * size));
        if (d) narrow = malloc((size_t)(2 * c * nodes) * sizeof(float));
        Classification asked = {0};
        asked.nodes = results, asked.node_strides[0] = 2 * n, asked.node_strides[1] = n;
        asked.mapped = valid, asked.mapped_stride = n, asked.rim = (uint8_t *)valid + nodes, asked.rim_stride = n;
        asked.count = c, asked.rows = rows, asked.columns = columns, asked.height = height, asked.width = width;
        asked.source_height = move.height, asked.source_width = move.width, asked.tolerance = share() * 0.1;
        asked.padding = (int32_t)below(3), asked.cells = cells, asked.scratch = scratch;
        Job jobs[2] = {{0}};
        jobs[0].count = jobs[1].count = c, sampled = 0;
        Lattices lattices = {move, asked, below(50), below(2), narrow, exact, &used, jobs, below(3)};
        const int64_t left = lattices_fuzzed(&lattices);
        fine &= left || sampled == c * lattices.job_count;
        fine &= used >= 0 && used <= c * rows * columns;
        for (int64_t i = 0; !left && i < c * rows * columns; i++)
            fine &= (cells[i] >= CELL_EMPTY && cells[i] < used) || (lattices.learns && cells[i] == CELL_QUINTIC);
        free(cells), free(scratch), free(exact);
    }
    for (int64_t at = 0; at < 2 * c * n && wide == 2; at++) {
        const int64_t camera = at / (2 * n), point = at / 2 % n;
        const int64_t place = camera * move.result_strides[0] + point * move.result_strides[1] + at % 2 * move.result_strides[2];
        const double value = d ? ((double *)results)[place] : ((float *)results)[place];
        /* what is moved off the image has its place, which may be too far for a number */
        fine &= fits || move.form == ON_IMAGE || ((uint8_t *)valid)[camera * n + point] == 1 || isfinite(value);
    }
    free(turns), free(narrow), free(valid), free(pixels), free(results);
    return fine;
}

static int fuzz(void) {
    Part parts[MOST_PARTS];
    Cameras cameras = {0};
    Rows rows = {0};
    int64_t numbers = 0, i;
    void *kept[60];
    int used = 0, fine = 1;
    memset(parts, 0, sizeof parts);
    const int d = (int)below(2), direction = (int)below(4), is_vjp = direction >= PROJECT_VJP;
    parts[0].kind = (int32_t)below(SPHERE + 1);
    if (parts[0].kind == CYLINDER || parts[0].kind == SPHERE) parts[0].flags = below(2) ? TRANSVERSE : 0;
    if (parts[0].kind == UNIFIED) parts[0].flags = (int32_t)below(8), parts[0].constant = (double)below(3) / 2;
    if (parts[0].kind == UNIFIED)
        for (i = 1; i < 8; i *= 2) numbers += !!(parts[0].flags & i);
    if (parts[0].kind == FOV || parts[0].kind == ONE_DIVISION) numbers = 1;
    if (parts[0].kind == INVERTED) numbers = factor_of(parts, POLYNOMIAL, ANGLE_OF_ALL_POWERS);
    cameras.part_count = 1 + below(4);
    for (i = 1; i < cameras.part_count; i++) {
        Part *part = parts + i;
        part->kind = PLANAR + (int32_t)below(4);
        if (part->kind == HOMOGRAPHY) numbers += 9;
        if (part->kind == SHEAR) numbers += 2;
        if (part->kind == SURFACE) {
            part->flags = 2 + (int32_t)below(2), part->n = part->flags + 1 + (int32_t)below(5), part->m = part->flags + 1 + (int32_t)below(5);
            numbers += 2 * part->n * part->m;
            for (int axis = 0; axis < 2; axis++) part->cells[axis] = 4 * share() - 1, part->centre[axis] = 2 * share() - 1;
        }
        if (part->kind != PLANAR) continue;
        part->flags = (int32_t)below(4);
        numbers += factor_of(part, i == 1 ? POLYNOMIAL : NO_FACTOR, i == 1 ? RADIUS_TABLE : RADIUS_POLYNOMIAL);
        if (part->factor == NO_FACTOR) numbers -= part->n + part->m, part->n = part->m = 0;
        numbers += 2 * !!(part->flags & TANGENTIAL) + 4 * !!(part->flags & PRISM);
    }
    const int has_table = cameras.part_count > 1 && parts[1].kind == PLANAR;
    const int64_t c = 1 + below(3), n = 1 + below(700), nodes = has_table ? parts[1].n + 1 : 0;
#define KEPT(...) (kept[used++] = (__VA_ARGS__))
    cameras.parts = parts, cameras.is_double = d, cameras.cameras = c, cameras.parameter_count = numbers;
    cameras.intrinsics = KEPT(filled(d, 4 * c, 100, 300));
    cameras.parameters = KEPT(filled(d, numbers * c, share(), 0));
    cameras.constants = KEPT(filled(d, nodes * c, 1, 1)), cameras.constant_count = nodes;
    cameras.safe_radius_sq = KEPT(filled(d, c, 2, 2)), cameras.image_radius_sq = KEPT(filled(d, c, 2, 2));
    if (below(2)) {
        cameras.limits2 = KEPT(filled(d, c * AZIMUTHS, 2, 2));
        cameras.extent = KEPT(filled(d, c * EXTENT, 2, 2));
    }
    if (has_table) cameras.table = KEPT(filled(d, c * (2 + 2 * NODES), 1, 1));
    if (has_table && cameras.part_count > 2 && below(2)) {
        uint8_t *by_stages = KEPT(malloc((size_t)c));
        for (i = 0; i < c; i++) by_stages[i] = (uint8_t)below(2);
        cameras.stagewise = by_stages, cameras.image_circle_sq = KEPT(filled(d, c, 2, 2));
    }
    if (parts[0].kind == INVERTED) {
        cameras.chart_safe_radius_sq = KEPT(filled(d, c, 2, 2)), cameras.chart_most2 = KEPT(filled(d, c, 2, 2));
        cameras.chart_table = KEPT(filled(d, c * (2 + 2 * NODES), 1, 1));
    }
    const int has_factor = has_table && parts[1].factor != NO_FACTOR, many = cameras.part_count > 2;
    Domain domain = {0};
    domain.parts = parts, domain.part_count = cameras.part_count, domain.is_double = d, domain.cameras = c;
    domain.parameters = KEPT(filled(1, numbers * c, share(), 0)), domain.parameter_count = numbers;
    domain.constants = KEPT(filled(1, nodes * c, 1, 1)), domain.constant_count = nodes;
    domain.ends = KEPT(filled(1, c, 2, 2)), domain.usual_ends = KEPT(filled(1, c, 2, 2)), domain.most = 1e30;
    if (below(2) || (has_table && parts[1].factor == RADIUS_TABLE)) domain.folds = KEPT(filled(1, c, 2, 2));
    domain.radii = KEPT(filled(1, MOST_RADII, 3, 3));
    domain.is_chart = parts[0].kind == INVERTED && below(2);
    domain.is_radial = has_factor && !many && !(parts[1].flags & (TANGENTIAL | PRISM));
    domain.safe_radius_sq = KEPT(filled(d, c, 0, 0)), domain.image_radius_sq = KEPT(filled(d, c, 0, 0));
    domain.table = KEPT(filled(d, c * (2 + 2 * NODES), 0, 0));
    if (has_factor && many && !domain.is_chart)
        domain.image_circle_sq = KEPT(filled(d, c, 0, 0)), domain.stagewise = KEPT(malloc((size_t)c));
    if (cameras.part_count > 1 && !domain.is_chart && below(4) == 0) {
        domain.coarse = KEPT(filled(1, RADII / 2, 3, 3)), domain.even = KEPT(filled(1, RADII, 3, 3));
        domain.limits2 = KEPT(filled(d, c * AZIMUTHS, 0, 0)), domain.extent = KEPT(filled(d, c * EXTENT, 0, 0));
    }
    if (cameras.part_count > 1 || domain.is_chart) domain_fuzzed(&domain);
    const int64_t size_in = direction % 2 ? 2 : 3, size_out = 5 - size_in;
    rows.cameras = &cameras, rows.count = n, rows.tile = 1 + below(600), rows.direction = direction;
    rows.rows = KEPT(rows_of(d, c, n, size_in, rows.row_strides, below(2) ? 0 : 300));
    rows.results = KEPT(rows_of(d, c, n, is_vjp ? size_in : size_out, rows.result_strides, 0));
    rows.valid = KEPT(malloc((size_t)(c * n)));
    for (i = 0; i < c * n; i++) rows.valid[i] = (uint8_t)below(2);
    if (below(2) || direction == UNPROJECT_VJP) rows.solution = KEPT(filled(d, 2 * c * n, 1, 0));
    if (is_vjp) {
        const int64_t tiles = (n + rows.tile - 1) / rows.tile;
        rows.cotangents = KEPT(rows_of(d, c, n, size_out, rows.cotangent_strides, 0));
        if (below(2)) rows.sums = KEPT(calloc((size_t)(c * tiles * (4 + numbers)), 8));
        if (below(4) == 0) rows.results = NULL;
    }
    geometry_fuzzed(&rows);
    if (!is_vjp) /* what is not valid is finite, whatever came */
        for (int64_t at = 0; at < c * n * size_out; at++) {
            const int64_t camera = at / (n * size_out), point = at / size_out % n;
            const int64_t place = camera * rows.result_strides[0] + point * rows.result_strides[1] +
                                  at % size_out * rows.result_strides[2];
            const double value = d ? ((double *)rows.results)[place] : ((float *)rows.results)[place];
            fine &= rows.valid[camera * n + point] == 1 || isfinite(value);
        }
    fine &= moved(&cameras, rows.tile);
    while (used) free(kept[--used]);
    return fine;
}

int main(int count, char **words) { return count == 3 ? all_jobs(words, fuzz) : 2; }
