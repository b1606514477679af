/* Lattices: which of their cells want exact positions, the positions of all pixels, and the transpose of that. Images are
 * sampled on them in sampler.c; nodes and exact positions are made in geometry.c.
 */
#include <math.h>
#include <string.h>

#include "sampler.h"
#include "unit.h"

/* -- which cells of a lattice want exact positions */

/* By differences of differences, which numbers that lie close together have without roundings */
INLINE float fourth(float a, float b, float c, float d, float e) {
    const float ab = b - a, bc = c - b, cd = d - c, de = e - d;
    return fabsf(((de - cd) - (cd - bc)) - ((cd - bc) - (bc - ab)));
}

static NOT_INLINE void windows(const float *a, const float *b, const float *c, const float *d, int64_t n,
                               float *__restrict most) {
    int64_t j;
    for (j = 0; j < n; j++) most[j] = greater(greater(a[j], b[j]), greater(c[j], d[j]));
}

/* The largest fourth differences across and down at a line of corners, of those of a cell and the next ones on either
 * side; nodes: of the first of the five rows around it */
static NOT_INLINE void misses(const float *nodes, int64_t width, int64_t n, float *line, float *across, float *down) {
    const float *r0 = nodes, *r1 = r0 + width, *r2 = r1 + width, *r3 = r2 + width, *r4 = r3 + width;
    int64_t j, k;
    for (k = 0; k < 2; k++) {
        float *most = k ? down : across;
        if (k)
            for (j = 0; j < n + 1; j++) line[j + 1] = fourth(r0[j + 2], r1[j + 2], r2[j + 2], r3[j + 2], r4[j + 2]);
        else
            for (j = 0; j < n + 1; j++) line[j + 1] = fourth(r2[j], r2[j + 1], r2[j + 2], r2[j + 3], r2[j + 4]);
        line[0] = line[1], line[n + 2] = line[n + 1];
        windows(line, line + 1, line + 2, line + 3, n, most);
    }
}

/* The range of a cell's sixteen nodes; nodes: of the first of its four rows */
static void ranges(const float *nodes, int64_t width, int64_t n, float *least, float *most, float *low, float *high) {
    const float *r0 = nodes, *r1 = r0 + width, *r2 = r1 + width, *r3 = r2 + width;
    int64_t j;
    for (j = 0; j < n + 3; j++) {
        least[j] = lesser(lesser(r0[j], r1[j]), lesser(r2[j], r3[j]));
        most[j] = greater(greater(r0[j], r1[j]), greater(r2[j], r3[j]));
    }
    for (j = 0; j < n; j++) {
        low[j] = lesser(lesser(least[j], least[j + 1]), lesser(least[j + 2], least[j + 3]));
        high[j] = greater(greater(most[j], most[j + 1]), greater(most[j + 2], most[j + 3]));
    }
}

/* Of one coordinate: adds to the squares of both, by which cubics may miss, and to whether they are near the image, 1 or
 * 0; scale: of the fourth differences across and down */
static NOT_INLINE void judge(const float *across, const float *down, float scale, const float *low, const float *high, int64_t n,
                      float not_border, float not_zeros, float *__restrict missed, float *__restrict near) {
    int64_t j;
    for (j = 0; j < n; j++) {
        const float of = scale * (across[j] + down[j]);
        const float reach = CELL_MARGIN + CELL_OVERSHOOT * (high[j] - low[j]);
        const float is_near = (high[j] + reach > -1 ? 1.0f : 0.0f) * (low[j] - reach < 1 ? 1.0f : 0.0f);
        /* beyond the border, one coordinate does not matter, but the other one does */
        missed[j] += greater(is_near, not_border) * of * of;
        near[j] *= greater(is_near, not_zeros);
    }
}

/* The cells; how many want exact positions, or may, in the image with the most of them */
int32_t THIS(classify)(const Classification *given) {
    const int64_t n = given->columns, width = n + 5, area = n + 8;
    const float limit = (float)(given->tolerance * given->tolerance);
    const float half[2] = {(float)(given->source_width / 2), (float)(given->source_height / 2)};
    const float not_border = given->padding != BORDER, not_zeros = given->padding != ZEROS;
    float *lines[9], *kept[2][2][4];
    int64_t b, i, j, c, k, made;
    int32_t most = 0;
    for (k = 0; k < 9; k++) lines[k] = given->scratch + k * area;
    for (k = 0; k < 16; k++) kept[k / 8][k / 4 % 2][k % 4] = given->scratch + (9 + k) * area;
    for (b = 0; b < given->count; b++) {
        int32_t *cells = given->cells + b * given->rows * n;
        for (i = 0, made = 0; i < given->rows; i++) {
            const uint8_t *m = given->mapped + b * given->mapped_stride + (i + 1) * width + 1;
            const float *planes = given->nodes + b * given->node_strides[0];
            float *missed = lines[0], *near = lines[1];
            /* the lines of corners that this row is the first to look at */
            for (; made <= given->rows && made < i + 3; made++)
                for (c = 0; c < 2; c++) {
                    const float *nodes = planes + c * given->node_strides[1] + made * width;
                    misses(nodes, width, n, lines[2], kept[c][0][made % 4], kept[c][1][made % 4]);
                }
            for (j = 0; j < n; j++) missed[j] = 0, near[j] = 1;
            for (c = 0; c < 2; c++) {
                const float *nodes = planes + c * given->node_strides[1] + i * width;
                for (k = 0; k < 2; k++) {
                    float **of = kept[c][k];
                    windows(of[(i > 0 ? i - 1 : 0) % 4], of[i % 4], of[(i + 1) % 4],
                            of[(i + 2 < given->rows ? i + 2 : given->rows) % 4], n, lines[3 + k]);
                }
                ranges(nodes + width + 1, width, n, lines[5], lines[6], lines[7], lines[8]);
                judge(lines[3], lines[4], CELL_MISSED * half[c], lines[7], lines[8], n, not_border, not_zeros, missed,
                      near);
            }
            uint8_t *sums = (uint8_t *)lines[2];
            for (j = 0; j < n + 3; j++) sums[j] = m[j] + m[j + width] + m[j + 2 * width] + m[j + 3 * width];
            for (j = 0; j < n; j++) {
                const int sum = sums[j] + sums[j + 1] + sums[j + 2] + sums[j + 3];
                /* what is not a number is not below the limit */
                const int doubt = (near[j] > 0) & !(missed[j] <= limit);
                cells[i * n + j] = sum == 0 ? CELL_EMPTY : sum < 16 ? 0 : doubt ? CELL_DOUBT : CELL_CUBIC;
            }
        }
        /* a pixel at the rim may say that the nodes do not tell all */
        const uint8_t *rim = given->rim + b * given->rim_stride;
        const int64_t last_row = (given->rows - 1) * n, last = (given->width - 1) / STEP;
#define LOOK(cell) \
    do { \
        int32_t *at = cells + (cell); \
        if (*at != 0 && (*rim != 0) != (*at != CELL_EMPTY)) *at = 0; \
        rim++; \
    } while (0)
        for (k = 0; k < given->width; k++) LOOK(k / STEP);
        for (k = 0; k < given->width; k++) LOOK(last_row + k / STEP);
        for (k = 0; k < given->height; k++) LOOK(k / STEP * n);
        for (k = 0; k < given->height; k++) LOOK(k / STEP * n + last);
        int32_t todo = 0;
        for (k = 0; k < given->rows * n; k++) todo += cells[k] == 0 || cells[k] == CELL_DOUBT;
        most = todo > most ? todo : most;
    }
    return most;
}

/* -- pixels of a lattice, u and v side by side, and the transpose of that */

enum { LAID = 64, LAID_ROWS = 16, AROUND = 6 }; /* cells of a line, lines of cells of a strip, nodes around a cell along an axis */
typedef float Pairs[2 * LAID * STEP];
typedef float Polynomials[AROUND][STEP];

/* Of the six nodes around a cell, those of polynomials through four, or all, on the way from its first one to the next */
static void lay_weights(int64_t taps, Polynomials weights) {
    const int first = (int)(AROUND - taps) / 2, end = AROUND - first;
    int j, k, m;
    memset(weights, 0, sizeof(Polynomials));
    for (j = first; j < end; j++)
        for (k = 0; k < STEP; k++) {
            double weight = 1;
            for (m = first; m < end; m++) weight *= m == j ? 1 : ((double)k / STEP + 2 - m) / (j - m);
            weights[j][k] = (float)weight;
        }
}

/* One polynomial is laid for most cells, all at once, and the other one for some */
typedef struct {
    Polynomials most, some;
    int32_t usual, rare; /* the cells of each */
} Kinds;

static void lay_kinds(const Laying *given, Kinds *kinds) {
    int64_t i, quintics = 0, cubics = 0;
    for (i = 0; i < given->count * given->rows * given->columns; i++) {
        cubics += given->cells[i] == CELL_CUBIC;
        quintics += given->cells[i] == CELL_QUINTIC;
    }
    lay_weights(quintics > cubics ? 6 : 4, kinds->most), lay_weights(quintics > cubics ? 4 : 6, kinds->some);
    kinds->usual = quintics > cubics ? CELL_QUINTIC : CELL_CUBIC, kinds->rare = CELL_QUINTIC + CELL_CUBIC - kinds->usual;
}

/* Some rows of cells of a camera, from the one at `first` on */
static void lay_strip(const Laying *given, const Kinds *kinds, int64_t b, int64_t first, int64_t end) {
    const float(*w)[STEP] = kinds->most, (*r)[STEP] = kinds->some;
    const int64_t width = given->columns + 5, plane = (given->rows + 5) * width, far = given->exact_count * STEP * STEP;
    int64_t column, i, j, y;
    int k, c;
    for (column = 0; column < given->columns; column += LAID) {
        const int64_t left = given->columns - column, count = left < LAID ? left : LAID, x = column * STEP;
        const int64_t n = given->width - x < count * STEP ? given->width - x : count * STEP;
        _Alignas(64) Pairs lines[AROUND];
        uint8_t mapped[LAID * STEP];
        for (i = first; i < end; i++) {
            const int32_t *cells = given->cells + (b * given->rows + i) * given->columns + column;
            for (j = i == first ? i : i + AROUND - 1; j < i + AROUND; j++) {
                const float *u = given->nodes + 2 * b * plane + j * width + column, *v = u + plane;
                for (y = 0; y < count; y++)
                    for (k = 0; k < STEP; k++) {
                        float *to = lines[j % AROUND] + 2 * (y * STEP + k), sums[2] = {0, 0};
                        for (c = 0; c < AROUND; c++) sums[0] += w[c][k] * u[y + c], sums[1] += w[c][k] * v[y + c];
                        to[0] = sums[0], to[1] = sums[1];
                    }
            }
            for (j = 0; j < count; j++) memset(mapped + j * STEP, cells[j] != CELL_EMPTY, STEP);
            const float *l0 = lines[i % AROUND], *l1 = lines[(i + 1) % AROUND], *l2 = lines[(i + 2) % AROUND];
            const float *l3 = lines[(i + 3) % AROUND], *l4 = lines[(i + 4) % AROUND], *l5 = lines[(i + 5) % AROUND];
            for (y = i * STEP; y < (i + 1) * STEP && y < given->height; y++) {
                const int64_t at = (b * given->height + y) * given->width + x;
                const int part = (int)(y % STEP);
                float *__restrict to = given->grid + 2 * at;
                const float w0 = w[0][part], w1 = w[1][part], w2 = w[2][part], w3 = w[3][part], w4 = w[4][part];
                const float w5 = w[5][part];
                for (j = 0; j < 2 * n; j++)
                    to[j] = l0[j] * w0 + l1[j] * w1 + l2[j] * w2 + l3[j] * w3 + l4[j] * w4 + l5[j] * w5;
                memcpy(given->mapped + at, mapped, (size_t)n);
                for (j = 0; j < n; j++) {
                    const int32_t cell = cells[j / STEP];
                    if (cell == kinds->usual) {
                        j += STEP - 1;
                    } else if (cell == kinds->rare) {
                        const float *node = given->nodes + 2 * b * plane + i * width + column + j / STEP;
                        to[2 * j] = to[2 * j + 1] = 0;
                        for (c = 0; c < AROUND * AROUND; c++) {
                            const float weight = r[c / AROUND][part] * r[c % AROUND][j % STEP];
                            to[2 * j] += weight * node[c / AROUND * width + c % AROUND];
                            to[2 * j + 1] += weight * node[c / AROUND * width + c % AROUND + plane];
                        }
                    } else {
                        const float *exact = given->exact + (cell * (int64_t)STEP + part) * STEP + j % STEP;
                        const int known = cell != CELL_EMPTY && exact[0] == exact[0];
                        to[2 * j] = known ? exact[0] : -9, to[2 * j + 1] = known ? exact[far] : -9;
                        given->mapped[at + j] = (uint8_t)known;
                    }
                }
            }
        }
    }
}

/* Adds what a line of gradients says to those of a row of nodes, and clears the line */
static void gather_line(const Polynomials w, float *line, int64_t count, float *u, float *v) {
    float turned[2 * STEP][LAID]; /* a row of cells for each of their pixels */
    int64_t j;
    int k, c;
    for (j = 0; j < count; j++)
        for (k = 0; k < 2 * STEP; k++) turned[k][j] = line[2 * STEP * j + k];
    for (c = 0; c < AROUND; c++)
        for (k = 0; k < STEP; k++) {
            for (j = 0; j < count; j++) u[j + c] += w[c][k] * turned[2 * k][j];
            for (j = 0; j < count; j++) v[j + c] += w[c][k] * turned[2 * k + 1][j];
        }
    memset(line, 0, (size_t)count * 2 * STEP * sizeof *line);
}

/* Adds a row of gradients to those of the six lines that it lies between, at `part` / 8 from the third to the fourth one */
static NOT_INLINE void spread_row(const Polynomials w, int part, const float *from, int64_t n, float *__restrict l0,
                           float *__restrict l1, float *__restrict l2, float *__restrict l3, float *__restrict l4,
                           float *__restrict l5) {
    const float w0 = w[0][part], w1 = w[1][part], w2 = w[2][part], w3 = w[3][part], w4 = w[4][part], w5 = w[5][part];
    int64_t j;
    for (j = 0; j < n; j++) {
        const float g = from[j];
        l0[j] += w0 * g, l1[j] += w1 * g, l2[j] += w2 * g, l3[j] += w3 * g, l4[j] += w4 * g, l5[j] += w5 * g;
    }
}

/* The gradients of a camera's nodes and exact positions */
static void gather(const Laying *given, const Kinds *kinds, int64_t b) {
    const float(*w)[STEP] = kinds->most, (*r)[STEP] = kinds->some;
    const int64_t width = given->columns + 5, plane = (given->rows + 5) * width, far = given->exact_count * STEP * STEP;
    int64_t column, i, j, y;
    int c;
    for (column = 0; column < given->columns; column += LAID) {
        const int64_t left = given->columns - column, count = left < LAID ? left : LAID, x = column * STEP;
        const int64_t n = given->width - x < count * STEP ? given->width - x : count * STEP;
        float *nodes = given->nodes + 2 * b * plane + column;
        _Alignas(64) Pairs lines[AROUND], own;
        memset(lines, 0, sizeof lines);
        for (i = 0; i < given->rows + AROUND - 1; i++) {
            const int32_t *cells = given->cells + (b * given->rows + i) * given->columns + column;
            int usual = 1;
            for (j = 0; j < count && i < given->rows; j++) usual &= cells[j] == kinds->usual;
            for (y = i * STEP; y < (i + 1) * STEP && y < given->height; y++) {
                const int part = (int)(y % STEP);
                const float *from = given->grid + 2 * ((b * given->height + y) * given->width + x);
                for (j = 0; j < n && !usual; j++) {
                    const int32_t cell = cells[j / STEP];
                    const int is_usual = cell == kinds->usual;
                    own[2 * j] = is_usual ? from[2 * j] : 0, own[2 * j + 1] = is_usual ? from[2 * j + 1] : 0;
                    if (cell == kinds->rare) {
                        float *node = nodes + i * width + j / STEP;
                        for (c = 0; c < AROUND * AROUND; c++) {
                            const float weight = r[c / AROUND][part] * r[c % AROUND][j % STEP];
                            node[c / AROUND * width + c % AROUND] += weight * from[2 * j];
                            node[c / AROUND * width + c % AROUND + plane] += weight * from[2 * j + 1];
                        }
                    } else if (!is_usual && cell != CELL_EMPTY) {
                        float *exact = given->exact + (cell * (int64_t)STEP + part) * STEP + j % STEP;
                        exact[0] = from[2 * j], exact[far] = from[2 * j + 1];
                    }
                }
                spread_row(w, part, usual ? from : own, 2 * n, lines[i % AROUND], lines[(i + 1) % AROUND],
                           lines[(i + 2) % AROUND], lines[(i + 3) % AROUND], lines[(i + 4) % AROUND], lines[(i + 5) % AROUND]);
            }
            gather_line(w, lines[i % AROUND], count, nodes + i * width, nodes + i * width + plane);
        }
    }
}

void THIS(lay)(Laying *given) {
    const int64_t strips = given->is_transposed ? 1 : (given->rows + LAID_ROWS - 1) / LAID_ROWS;
    int64_t i;
    Kinds kinds;
    lay_kinds(given, &kinds);
    while ((i = __atomic_fetch_add(&given->next, 1, __ATOMIC_RELAXED)) < strips * given->count) {
        const int64_t first = i % strips * LAID_ROWS, end = first + LAID_ROWS;
        if (given->is_transposed) gather(given, &kinds, i);
        else lay_strip(given, &kinds, i / strips, first, end < given->rows ? end : given->rows);
    }
}
