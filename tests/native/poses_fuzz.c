/* Random rows for the search for poses and for linearised views, seen by a pinhole of its own instead of the geometry: built
 * with sanitizers, it shows that none reads or writes outside, and that what is valid is finite.
 * See `all_jobs`.
 */
#include <math.h>

#include "chance.h"
#include "poses.h"

void poses_fuzzed(const Poses *);
void views_fuzzed(const Views *);
void steps_fuzzed(const Steps *);

/* Of 500 px, and two parameters that do nothing */
int64_t geometry_fuzzed(const Rows *rows) {
    for (int64_t i = 0; i < rows->count; i++) {
        const double *from = (const double *)rows->rows + i * rows->row_strides[1];
        double *to = rows->results ? (double *)rows->results + i * rows->result_strides[1] : NULL;
        if (rows->direction == PROJECT) {
            rows->valid[i] = from[2] > 0 && isfinite(from[0] + from[1] + from[2]);
            for (int k = 0; k < 2; k++) to[k] = rows->valid[i] ? 500 * from[k] / from[2] : -1;
        } else if (rows->direction == UNPROJECT) {
            const double x = from[0] / 500, y = from[1] / 500, length = sqrt(x * x + y * y + 1);
            rows->valid[i] = isfinite(x * x + y * y);
            to[0] = rows->valid[i] ? x / length : 0, to[1] = rows->valid[i] ? y / length : 0, to[2] = rows->valid[i] ? 1 / length : 1;
        } else {
            const double *by = rows->cotangents, z = from[2] > 0 ? from[2] : INFINITY;
            to[0] = 500 * by[0] / z, to[1] = 500 * by[1] / z, to[2] = -500 * (by[0] * from[0] + by[1] * from[1]) / z / z;
            for (int64_t k = 0; rows->sums && k < 4 + rows->cameras->parameter_count; k++)
                rows->sums[i * (4 + rows->cameras->parameter_count) + k] += by[k % 2];
        }
    }
    return 0;
}

static double *filled(int64_t count, double size) {
    static const double wild[] = {0, NAN, INFINITY, 1e300, -1e300, 1e-300};
    double *made = malloc((size_t)count * sizeof *made + (count == 0));
    const int is_wild = !below(4);
    for (int64_t i = 0; i < count; i++) made[i] = is_wild && !below(20) ? wild[below(6)] : size * (2 * share() - 1);
    return made;
}

/* Whether all is finite of rows that are valid */
static int fine(const double *values, const uint8_t *valid, int64_t rows, int64_t size) {
    for (int64_t i = 0; i < rows * size; i++)
        if (valid[i / size] && !isfinite(values[i])) return 0;
    return 1;
}

static int job(void) {
    const int64_t rows = 1 + below(4), points = below(3) ? 4 + below(12) : 1 + below(4), views = 1 + below(3);
    const int64_t task = below(4), of_points = below(2) ? rows : 1, poses = task == FROM_RAYS ? 2 * rows : rows;
    double *object = filled(of_points * points * 3, 1), *pixels = filled(rows * points * 2, 400);
    double *weights = filled(rows * points, 1), *rays = filled(rows * points * 3, 1), *rotations = filled(poses * 9, 0);
    double *translations = filled(poses * 3, 1), *vectors = filled(3 * rows, 1), *rms = filled(rows, 1);
    double *covariance = filled(36 * rows, 1), *costs = filled(rows, 1);
    uint8_t *valid = malloc((size_t)poses), *inliers = malloc((size_t)(rows * points));
    int64_t next = 0, left = 0;
    const Part part = {.kind = PERSPECTIVE};
    const double intrinsics[4] = {500, 500, 0, 0};
    const Cameras cameras = {.parts = &part, .part_count = 1, .is_double = 1, .cameras = 1, .intrinsics = intrinsics,
                             .parameter_count = 2};
    const int is_flat = !below(3);
    for (int64_t i = 0; i < of_points * points * 3; i++) object[i] = is_flat && i % 3 == 2 ? 0 : object[i];
    for (int64_t i = 0; i < rows * points; i++) weights[i] = weights[i] > -0.8 ? fabs(weights[i]) : 0;
    for (int64_t i = 0; i < 9 * poses; i++) rotations[i] = i % 9 % 4 == 0;
    for (int64_t i = 0; i < 3 * poses; i++) translations[i] = i % 3 == 2 ? 3 : share() - 0.5;
    for (int64_t i = 0; i < rows * points; i++) {
        const double *r = rays + 3 * i, length = sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2]);
        for (int k = 0; k < 3; k++) rays[3 * i + k] /= length;
    }
    if (task == REFINED)
        for (int64_t i = 0; i < rows * points; i++) weights[i] = isfinite(weights[i]) && weights[i] < 9 ? weights[i] : 0;
    const Poses given = {&cameras, object, rays, pixels, below(3) || task < SOLVED ? weights : NULL, of_points, rows, points,
                         task, below(3), below(20), 1.5, 1e-7, 1e-9, 1e-8, 50, rotations, translations, valid, costs,
                         vectors, rms, inliers, covariance, &next, &left};
    poses_fuzzed(&given);
    int is_fine = fine(rotations, valid, poses, 9) && fine(translations, valid, poses, 3);
    if (task >= SOLVED) is_fine &= fine(vectors, valid, rows, 3) && fine(rms, valid, rows, 1);
    const int64_t numbers = below(5), learnt[4] = {0, 2, 4, 5}, width = 7 + numbers;
    double *boards = filled(rows * views * points * 3, 1), *turns = filled(rows * views * 9, 1);
    double *shifts = filled(rows * views * 3, 1), *residuals = filled(rows * views * points * 2, 1);
    double *squares = filled(rows * views * points, 1), *view = filled(rows * views * 6 * width, 1);
    double *shared = filled(rows * (numbers + 1) * (numbers + 1), 1);
    double *at = filled(rows * views * points * 2, 400), *used = filled(rows * views * points, 1);
    double *costs_of = filled(rows * views, 1);
    uint8_t *mapped = malloc((size_t)(rows * views * points));
    for (int64_t i = 0; i < rows * views * points; i++) squares[i] = squares[i] > 0 ? squares[i] : 0;
    Views seen = {&cameras, boards, {views * points * 3, points * 3}, turns, shifts, at, squares, residuals, used, mapped,
                  costs_of, rows, views, points, below(3), 1.5, learnt, numbers, NULL, shared, &left};
    views_fuzzed(&seen);
    seen.view = view;
    views_fuzzed(&seen);
    const int64_t unknowns = below(2) ? 6 : 0, many = unknowns ? views : 0;
    double *damping = filled(rows, 1), *of_views = filled(rows * many * unknowns, 1), *of_shared = filled(rows * numbers, 1);
    double *rest = filled(rows, 1);
    for (int64_t i = 0; i < rows; i++) damping[i] = fabs(damping[i]);
    const Steps steps = {view, shared, damping, rows, many, unknowns, numbers, of_views, of_shared, rest, &left};
    steps_fuzzed(&steps);
    for (int64_t i = 0; i < rows * numbers; i++) is_fine &= isfinite(of_shared[i]);
    void *all[] = {object, pixels, weights, rays, rotations, translations, vectors, rms, covariance, costs, valid, inliers,
                   boards, turns, shifts, residuals, squares, view, shared, at, used, costs_of, mapped, damping, of_views,
                   of_shared, rest};
    for (size_t i = 0; i < sizeof all / sizeof *all; i++) free(all[i]);
    return is_fine && left == 0;
}

int main(int count, char **words) { return count == 3 ? all_jobs(words, job) : 2; }
