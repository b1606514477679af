/* Views of cameras, linearised, as triangles of a QR; `Bundle.equations` of camtorch/calibration/bundle.py. */
#include "poses.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define NAMED(name, variant) name##_##variant
#define EXPANDED(name, variant) NAMED(name, variant)
#define THIS(name) EXPANDED(name, VARIANT)

int64_t THIS(geometry)(const Rows *);

/* In eight sums, which a compiler can have in registers side by side */
static double product(const double *restrict a, const double *restrict b, int64_t count) {
    double sums[8] = {0}, sum = 0;
    int64_t i = 0;
    for (; i + 8 <= count; i += 8)
        for (int k = 0; k < 8; k++) sums[k] += a[i + k] * b[i + k];
    for (; i < count; i++) sum += a[i] * b[i];
    for (int k = 0; k < 8; k++) sum += sums[k];
    return sum;
}

/* Columns (width, rows), of which the triangle of a QR of the first `count` is left: by Householder's reflections */
static void reduce(double *columns, int64_t width, int64_t rows, int64_t count) {
    for (int64_t k = 0; k < count; k++) {
        double *own = columns + k * rows;
        const int64_t rest = rows - k;
        const double square = product(own + k, own + k, rest);
        if (!(square > 0)) continue;
        const double length = own[k] > 0 ? -sqrt(square) : sqrt(square), first = own[k] - length;
        const double by = 1 / (length * first); /* of the reflection I + by v v^T, v of first element `first` */
        own[k] = first;
        for (int64_t j = k + 1; j < width; j++) {
            double *restrict other = columns + j * rows + k;
            const double along = by * product(own + k, other, rest);
            for (int64_t i = 0; i < rest; i++) other[i] += along * own[k + i];
        }
        own[k] = length;
        for (int64_t i = k + 1; i < rows; i++) own[i] = 0;
    }
}

/* x of triangle x = right, columns of so many rows; where the triangle is zero, nothing */
static void solved(const double *columns, int64_t width, int64_t rows, const double *right, double *x) {
    for (int64_t i = width - 1; i >= 0; i--) {
        const double diagonal = columns[i * rows + i];
        x[i] = diagonal == 0 ? 0 : right[i];
        for (int64_t j = i + 1; j < width; j++) x[i] -= columns[j * rows + i] * x[j];
        x[i] /= diagonal == 0 ? 1 : diagonal;
    }
}

/* The points of a view in the frame of its camera */
static void moved_to(const Views *given, int64_t problem, int64_t view, double *moved) {
    const double *points = given->points + problem * given->point_strides[0] + view * given->point_strides[1];
    const int64_t at = problem * given->views + view;
    const double *rotation = given->rotations + 9 * at, *shift = given->translations + 3 * at;
    for (int64_t i = 0; i < given->count; i++)
        for (int k = 0; k < 3; k++) {
            const double *r = rotation + 3 * k, *p = points + 3 * i;
            moved[3 * i + k] = r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + shift[k];
        }
}

/* Residuals, weights, and the cost of a view; `Bundle.look`. How many points wait */
static int64_t look(const Views *given, const Cameras *camera, int64_t problem, int64_t view, double *moved) {
    const int64_t n = given->count, at = problem * given->views + view;
    double *residuals = given->residuals + at * n * 2, *weights = given->weights + at * n, *cost = given->costs + at;
    const double *pixels = given->pixels + at * n * 2, *of_points = given->given + at * n;
    uint8_t *valid = given->valid + at * n;
    moved_to(given, problem, view, moved);
    const Rows of = {.cameras = camera, .rows = moved, .row_strides = {3 * n, 3, 1}, .results = residuals,
                     .result_strides = {2 * n, 2, 1}, .valid = valid, .count = n, .tile = n, .direction = PROJECT};
    const int64_t left = THIS(geometry)(&of);
    *cost = 0;
    for (int64_t i = 0; i < n; i++) {
        double *residual = residuals + 2 * i, weight;
        const int counts = valid[i] && of_points[i] > 0;
        for (int k = 0; k < 2; k++) residual[k] = counts ? residual[k] - pixels[2 * i + k] : 0;
        const double square = valid[i] ? residual[0] * residual[0] + residual[1] * residual[1] : LOST * LOST;
        *cost += of_points[i] * robust(given->loss, given->loss_scale, square, &weight);
        weights[i] = valid[i] ? weight * of_points[i] : 0;
    }
    return left;
}

/* The columns (6 + columns + 1, rows) of a view, whose rows are u and v of each point */
static void columns_of(const Views *given, const Cameras *camera, int64_t problem, int64_t view, double *columns,
                       int64_t rows, double *moved, double *slopes, double *sums, int by_numbers) {
    static const double ones[3] = {0, 1, 0};
    const int64_t n = given->count, width = 4 + camera->parameter_count, at = problem * given->views + view;
    const double *shift = given->translations + 3 * at;
    const double *residuals = given->residuals + at * n * 2, *weights = given->weights + at * n;
    moved_to(given, problem, view, moved);
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
            if (!given->view) {
                *given->left += look(given, &camera, problem, view, moved);
                continue;
            }
            for (int64_t j = 0; j < width; j++)
                for (int64_t i = 2 * n; i < rows; i++) columns[j * rows + i] = 0;
            columns_of(given, &camera, problem, view, columns, rows, moved, slopes, sums, learnt > 0);
            reduce(columns, width, rows, width);
            double *to = given->view + (problem * given->views + view) * 6 * width;
            for (int64_t i = 0; i < 6; i++)
                for (int64_t j = 0; j < width; j++) to[i * width + j] = j < i ? 0 : columns[j * rows + i];
            for (int64_t j = 0; j < own; j++)
                for (int64_t i = 0; i < own; i++) stacked[j * all + view * own + i] = i > j ? 0 : columns[(6 + j) * rows + 6 + i];
        }
        if (!given->view) continue;
        reduce(stacked, own, all, own);
        double *to = given->shared + problem * own * own;
        for (int64_t i = 0; i < own; i++)
            for (int64_t j = 0; j < own; j++) to[i * own + j] = j < i || i >= all ? 0 : stacked[j * all + i];
    }
    free(memory);
}

void THIS(steps)(const Steps *given) {
    const int64_t w = given->width, g = given->columns, views = given->views, own = g + 1, width = w + own;
    const int64_t rows = own + g + views * w;
    double *memory = malloc((size_t)(views * width * 2 * w + own * rows + g + w) * sizeof *memory);
    if (!memory) {
        *given->left = -1;
        return;
    }
    double *stacked = memory + views * width * 2 * w, *scales = stacked + own * rows, *right = scales + g;
    for (int64_t problem = 0; problem < given->problems; problem++) {
        const double root = sqrt(given->damping[problem]);
        const double *all = given->view + problem * views * w * width, *shared = given->shared + problem * own * own;
        double *of_views = given->of_views + problem * views * w, *whole = given->of_shared + problem * g, rest = 0;
        memset(memory, 0, (size_t)(views * width * 2 * w + own * rows + g) * sizeof *memory);
        for (int64_t view = 0; view < views; view++) {
            double *columns = memory + view * width * 2 * w;
            for (int64_t j = 0; j < width; j++) {
                double *column = columns + j * 2 * w;
                for (int64_t i = 0; i < w; i++) column[i] = all[(view * w + i) * width + j];
                const double square = product(column, column, w);
                if (j < w) column[w + j] = root * (square > 0 ? sqrt(square) : 1);
                else if (j < w + g) scales[j - w] += square;
            }
            reduce(columns, width, 2 * w, w);
        }
        for (int64_t j = 0; j < own; j++) { /* columns differ by many orders of magnitude */
            double *column = stacked + j * rows;
            for (int64_t i = 0; i < own; i++) column[i] = shared[i * own + j];
            if (j < g) scales[j] += product(column, column, g), scales[j] = scales[j] > 0 ? sqrt(scales[j]) : 1;
            for (int64_t i = 0; i < views * w; i++)
                column[own + g + i] = memory[(i / w * width + w + j) * 2 * w + w + i % w];
            for (int64_t i = 0; i < rows && j < g; i++) column[i] /= scales[j];
            if (j < g) column[own + j] = root;
        }
        reduce(stacked, own, rows, g);
        solved(stacked, g, rows, stacked + g * rows, whole);
        for (int64_t j = 0; j < g; j++) whole[j] /= -scales[j], rest += whole[j];
        for (int64_t view = 0; view < views; view++) {
            const double *columns = memory + view * width * 2 * w;
            for (int64_t i = 0; i < w; i++) {
                right[i] = -columns[(w + g) * 2 * w + i];
                for (int64_t j = 0; j < g; j++) right[i] -= columns[(w + j) * 2 * w + i] * whole[j];
            }
            solved(columns, w, 2 * w, right, of_views + view * w);
            for (int64_t i = 0; i < w; i++) rest += of_views[view * w + i];
        }
        if (!isfinite(rest)) {
            memset(whole, 0, (size_t)g * sizeof *whole);
            memset(of_views, 0, (size_t)(views * w) * sizeof *of_views);
        }
        rest = 0;
        for (int64_t i = 0; i < views * w + g; i++) {
            const int is_view = i < views * w;
            const double *row = is_view ? all + i * width : shared + (i - views * w) * own;
            double sum = is_view ? product(row, of_views + i / (w ? w : 1) * w, w) : 0;
            row += is_view ? w : 0;
            sum += product(row, whole, g) + row[g];
            rest += sum * sum;
        }
        given->rest[problem] = rest;
    }
    free(memory);
}
