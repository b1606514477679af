/* Views of cameras, linearised, as triangles of a QR, and their damped steps. */
#include <stdlib.h>

#include "views.h"

void THIS(views)(const Views *given) {
    const int64_t n = given->count, learnt = given->columns, width = 7 + learnt, own = learnt + 1;
    const int64_t rows = 2 * n > width ? 2 * n : width, all = given->views * own;
    const int64_t numbers = 4 + given->cameras->parameter_count;
    double *memory = calloc((size_t)(width * rows + 6 * n + n * numbers + all * own), sizeof *memory);
    if (!memory) {
        *given->left = -1;
        return;
    }
    double *columns = memory, *stacked = columns + width * rows, *free_ = stacked + all * own;
    for (int64_t problem = 0; problem < given->problems; problem++) {
        const Cameras camera = only(given->cameras, problem);
        for (int64_t number = 0; number < given->views; number++) {
            const int64_t at = problem * given->views + number;
            View view = {&camera, given->points + problem * given->point_strides[0] + number * given->point_strides[1],
                         given->pixels + at * n * 2, given->given + at * n, given->rotations + 9 * at,
                         given->translations + 3 * at, n, given->loss, given->loss_scale, given->residuals + at * n * 2,
                         given->weights + at * n, given->valid + at * n, free_, free_ + 3 * n, free_ + 6 * n, 0};
            given->costs[at] = look(&view);
            *given->left += view.left;
            if (!given->view) continue;
            columns_of(&view, given->learnt, learnt, columns, rows);
            reduce(columns, width, rows, width);
            double *to = given->view + at * 6 * width;
            for (int64_t i = 0; i < 6; i++)
                for (int64_t j = 0; j < width; j++) to[i * width + j] = j < i ? 0 : columns[j * rows + i];
            for (int64_t j = 0; j < own; j++)
                for (int64_t i = 0; i < own; i++) stacked[j * all + number * own + i] = i > j ? 0 : columns[(6 + j) * rows + 6 + i];
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
    const int64_t w = given->width, g = given->columns, views = given->views, width = w + g + 1;
    double *memory = malloc((size_t)numbers_of_step(views, w, g) * sizeof *memory);
    if (!memory) {
        *given->left = -1;
        return;
    }
    for (int64_t i = 0; i < given->problems; i++)
        given->rest[i] = step(given->view + i * views * w * width, given->shared + i * (g + 1) * (g + 1), given->damping[i], views,
                              w, g, given->of_views + i * views * w, given->of_shared + i * g, memory);
    free(memory);
}
