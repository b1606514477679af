/* One view of a camera: residuals, their derivatives, and damped steps. `Bundle.look` and `Bundle.rows_of` of
 * camtorch/calibration/bundle.py, `System.step` of camtorch/least_squares/equations.py. */
#ifndef CAMTORCH_VIEWS_H
#define CAMTORCH_VIEWS_H

#include "poses.h"
#include "small.h"

int64_t THIS(geometry)(const Rows *);

typedef struct {
    const Cameras *camera;
    const double *points, *pixels, *given; /* (n, 3), (n, 2), (n): the weights of squares, 0 for unseen */
    const double *rotation, *shift;
    int64_t count, loss;
    double loss_scale;
    double *residuals, *weights;   /* (n, 2), (n): what `look` makes of them */
    uint8_t *valid;                /* (n) */
    double *moved, *slopes, *sums; /* for a while: (n, 3), (n, 3), (n, 4 + the camera's parameters) */
    int64_t left;                  /* how many points wait for limits of lenses */
} View;

/* In eight sums, which a compiler can have in registers side by side */
static inline double product(const double *restrict a, const double *restrict b, int64_t count) {
    double sums[8] = {0}, sum = 0;
    int64_t i = 0;
    for (; i + 8 <= count; i += 8)
        for (int k = 0; k < 8; k++) sums[k] += a[i + k] * b[i + k];
    for (; i < count; i++) sum += a[i] * b[i];
    for (int k = 0; k < 8; k++) sum += sums[k];
    return sum;
}

/* Columns (width, rows), of which the triangle of a QR of the first `count` is left: by Householder's reflections */
static inline void reduce(double *columns, int64_t width, int64_t rows, int64_t count) {
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
static inline void back(const double *columns, int64_t width, int64_t rows, const double *right, double *x) {
    for (int64_t i = width - 1; i >= 0; i--) {
        const double diagonal = columns[i * rows + i];
        x[i] = diagonal == 0 ? 0 : right[i];
        for (int64_t j = i + 1; j < width; j++) x[i] -= columns[j * rows + i] * x[j];
        x[i] /= diagonal == 0 ? 1 : diagonal;
    }
}

/* Residuals and weights of a view; its cost */
static inline double look(View *view) {
    const int64_t n = view->count;
    double *residual = view->residuals, cost = 0, weight;
    for (int64_t i = 0; i < n; i++) {
        applied(view->rotation, view->points + 3 * i, view->moved + 3 * i);
        for (int k = 0; k < 3; k++) view->moved[3 * i + k] += view->shift[k];
    }
    const Rows of = {.cameras = view->camera, .rows = view->moved, .row_strides = {3 * n, 3, 1}, .results = residual,
                     .result_strides = {2 * n, 2, 1}, .valid = view->valid, .count = n, .tile = n, .direction = PROJECT};
    view->left += THIS(geometry)(&of);
    for (int64_t i = 0; i < n; i++, residual += 2) {
        const int counts = view->valid[i] && view->given[i] > 0;
        for (int k = 0; k < 2; k++) residual[k] = counts ? residual[k] - view->pixels[2 * i + k] : 0;
        const double square = view->valid[i] ? residual[0] * residual[0] + residual[1] * residual[1] : LOST * LOST;
        cost += view->given[i] * robust(view->loss, view->loss_scale, square, &weight);
        view->weights[i] = view->valid[i] ? weight * view->given[i] : 0;
    }
    return cost;
}

/* The columns (6 + count + 1, rows) of the view that `look` saw last, whose rows are u and v of each point, and zeros: by turn
   and shift, by the numbers that learn, the residuals */
static inline void columns_of(const View *view, const int64_t *learnt, int64_t count, double *columns, int64_t rows) {
    static const double ones[3] = {0, 1, 0};
    const int64_t n = view->count, width = 4 + view->camera->parameter_count;
    const double *intrinsics = view->camera->intrinsics, *shift = view->shift, *p = view->moved;
    int by_lens = 0;
    for (int64_t j = 0; j < count; j++) by_lens |= learnt[j] >= 4;
    memset(columns, 0, (size_t)((7 + count) * rows) * sizeof *columns);
    for (int by = 0; by < 2; by++) {
        if (by_lens) memset(view->sums, 0, (size_t)(n * width) * sizeof *columns);
        const Rows of = {.cameras = view->camera, .rows = p, .row_strides = {3 * n, 3, 1}, .results = view->slopes,
                         .result_strides = {3 * n, 3, 1}, .cotangents = ones + 1 - by, .cotangent_strides = {0, 0, 1},
                         .sums = by_lens ? view->sums : NULL, .count = n, .tile = by_lens ? 1 : n, .direction = PROJECT_VJP};
        THIS(geometry)(&of);
        for (int64_t i = 0; i < n; i++) {
            const double root = sqrt(view->weights[i]), *s = view->slopes + 3 * i, residual = view->residuals[2 * i + by];
            const double turned[3] = {p[3 * i] - shift[0], p[3 * i + 1] - shift[1], p[3 * i + 2] - shift[2]};
            double *row = columns + 2 * i + by, along[6];
            if (!(root > 0)) continue;
            cross(turned, s, along);
            for (int k = 0; k < 3; k++) row[k * rows] = root * along[k], row[(3 + k) * rows] = root * s[k];
            for (int64_t j = 0; j < count; j++) {
                const int64_t number = learnt[j];
                double slope = number % 2 == by;
                if (number >= 4) slope = view->sums[i * width + number];
                else if (number < 2) slope *= (residual + view->pixels[2 * i + by] - intrinsics[2 + by]) / intrinsics[by];
                row[(6 + j) * rows] = isfinite(slope) ? root * slope : 0;
            }
            row[(6 + count) * rows] = root * residual;
        }
    }
}

/* How many numbers `step` has for a while */
static inline int64_t numbers_of_step(int64_t views, int64_t w, int64_t g) {
    return views * (w + g + 1) * 2 * w + (g + 1) * (2 * g + 1 + views * w) + g + w;
}

/* A damped step of views with w unknowns each (v, w) and of the g that they share (g), by their triangles
   (v, w, w + g + 1) and (g + 1, g + 1); what it leaves of the decrement */
static inline double step(const double *all, const double *shared, double damping, int64_t views, int64_t w, int64_t g,
                          double *of_views, double *whole, double *memory) {
    const int64_t own = g + 1, width = w + own, rows = own + g + views * w;
    double *stacked = memory + views * width * 2 * w, *scales = stacked + own * rows, *right = scales + g, rest = 0;
    const double root = sqrt(damping);
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
    back(stacked, g, rows, stacked + g * rows, whole);
    for (int64_t j = 0; j < g; j++) whole[j] /= -scales[j], rest += whole[j];
    for (int64_t view = 0; view < views; view++) {
        const double *columns = memory + view * width * 2 * w;
        for (int64_t i = 0; i < w; i++) {
            right[i] = -columns[(w + g) * 2 * w + i];
            for (int64_t j = 0; j < g; j++) right[i] -= columns[(w + j) * 2 * w + i] * whole[j];
        }
        back(columns, w, 2 * w, right, of_views + view * w);
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
    return rest;
}

#endif
