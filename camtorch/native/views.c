/* Views of cameras, linearised, as triangles of a QR; `Bundle.equations` of camtorch/calibration/bundle.py. */
#include "poses.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define NAMED(name, variant) name##_##variant
#define EXPANDED(name, variant) NAMED(name, variant)
#define THIS(name) EXPANDED(name, VARIANT)

int64_t THIS(geometry)(const Rows *);

/* Columns (width, rows), of which the triangle of a QR is left in the first rows: by Householder's reflections */
static void reduce(double *columns, int64_t width, int64_t rows) {
    for (int64_t k = 0; k < width; k++) {
        double *restrict own = columns + k * rows, square = 0;
        for (int64_t i = k; i < rows; i++) square += own[i] * own[i];
        if (!(square > 0)) continue;
        const double length = own[k] > 0 ? -sqrt(square) : sqrt(square), first = own[k] - length;
        const double by = 1 / (length * first); /* of the reflection I + by v v^T, v of first element `first` */
        own[k] = first;
        for (int64_t j = k + 1; j < width; j++) {
            double *restrict other = columns + j * rows, product = 0;
            for (int64_t i = k; i < rows; i++) product += own[i] * other[i];
            product *= by;
            for (int64_t i = k; i < rows; i++) other[i] += product * own[i];
        }
        own[k] = length;
        for (int64_t i = k + 1; i < rows; i++) own[i] = 0;
    }
}

/* The columns (6 + columns + 1, rows) of a view, whose rows are u and v of each point */
static void columns_of(const Views *given, const Cameras *camera, int64_t problem, int64_t view, double *columns,
                       int64_t rows, double *moved, double *slopes, double *sums, int by_numbers) {
    static const double ones[3] = {0, 1, 0};
    const int64_t n = given->count, width = 4 + camera->parameter_count, at = problem * given->views + view;
    const double *points = given->points + problem * given->point_strides[0] + view * given->point_strides[1];
    const double *rotation = given->rotations + 9 * at, *shift = given->translations + 3 * at;
    const double *residuals = given->residuals + at * n * 2, *weights = given->weights + at * n;
    for (int64_t i = 0; i < n; i++)
        for (int k = 0; k < 3; k++) {
            const double *r = rotation + 3 * k, *p = points + 3 * i;
            moved[3 * i + k] = r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + shift[k];
        }
    for (int by = 0; by < 2; by++) {
        if (by_numbers) memset(sums, 0, (size_t)(n * width) * sizeof *sums);
        const Rows of = {.cameras = camera, .rows = moved, .row_strides = {3 * n, 3, 1}, .results = slopes,
                         .result_strides = {3 * n, 3, 1}, .cotangents = ones + 1 - by, .cotangent_strides = {0, 0, 1},
                         .sums = by_numbers ? sums : NULL, .count = n, .tile = by_numbers ? 1 : n, .direction = PROJECT_VJP};
        THIS(geometry)(&of);
        for (int64_t i = 0; i < n; i++) {
            const double root = sqrt(weights[i]), *s = slopes + 3 * i;
            const double x = moved[3 * i] - shift[0], y = moved[3 * i + 1] - shift[1], z = moved[3 * i + 2] - shift[2];
            double *row = columns + 2 * i + by;
            if (!(root > 0)) {
                for (int64_t j = 0; j < 7 + given->columns; j++) row[j * rows] = 0;
                continue;
            }
            row[0] = root * (y * s[2] - z * s[1]), row[rows] = root * (z * s[0] - x * s[2]);
            row[2 * rows] = root * (x * s[1] - y * s[0]);
            for (int k = 0; k < 3; k++) row[(3 + k) * rows] = root * s[k];
            for (int64_t j = 0; j < given->columns; j++) {
                const double slope = sums[i * width + given->learnt[j]];
                row[(6 + j) * rows] = isfinite(slope) ? root * slope : 0;
            }
            row[(6 + given->columns) * rows] = root * residuals[2 * i + by];
        }
    }
}

void THIS(views)(const Views *given) {
    const int64_t n = given->count, learnt = given->columns, width = 7 + learnt, own = learnt + 1;
    const int64_t rows = 2 * n > width ? 2 * n : width, all = given->views * own;
    const int64_t numbers = 4 + given->cameras->parameter_count;
    double *memory = calloc((size_t)(width * rows + 6 * n + n * numbers + all * own), sizeof *memory);
    if (!memory) {
        *given->left = -1;
        return;
    }
    double *columns = memory, *moved = columns + width * rows, *slopes = moved + 3 * n, *sums = slopes + 3 * n;
    double *stacked = sums + n * numbers;
    for (int64_t problem = 0; problem < given->problems; problem++) {
        const Cameras camera = only(given->cameras, problem);
        for (int64_t view = 0; view < given->views; view++) {
            for (int64_t j = 0; j < width; j++)
                for (int64_t i = 2 * n; i < rows; i++) columns[j * rows + i] = 0;
            columns_of(given, &camera, problem, view, columns, rows, moved, slopes, sums, learnt > 0);
            reduce(columns, width, rows);
            double *to = given->view + (problem * given->views + view) * 6 * width;
            for (int64_t i = 0; i < 6; i++)
                for (int64_t j = 0; j < width; j++) to[i * width + j] = j < i ? 0 : columns[j * rows + i];
            for (int64_t j = 0; j < own; j++)
                for (int64_t i = 0; i < own; i++) stacked[j * all + view * own + i] = i > j ? 0 : columns[(6 + j) * rows + 6 + i];
        }
        reduce(stacked, own, all);
        double *to = given->shared + problem * own * own;
        for (int64_t i = 0; i < own; i++)
            for (int64_t j = 0; j < own; j++) to[i * own + j] = j < i || i >= all ? 0 : stacked[j * all + i];
    }
    free(memory);
}
