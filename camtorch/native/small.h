/* Linear algebra of few numbers. Matrices are rows after rows. */
#ifndef CAMTORCH_SMALL_H
#define CAMTORCH_SMALL_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "glibc.h"
#include "unit.h"

static inline double number(const void *from, int64_t at, int64_t is_double) {
    return is_double ? ((const double *)from)[at] : ((const float *)from)[at];
}

static inline void put(void *to, int64_t at, double value, int64_t is_double) {
    if (is_double) ((double *)to)[at] = value;
    else ((float *)to)[at] = (float)value;
}

static inline double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static inline void cross(const double *a, const double *b, double *c) {
    const double x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0], c[0] = x, c[1] = y;
}

/* c = a b, 3 x 3 */
static inline void multiplied(const double *a, const double *b, double *c) {
    double made[9];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) made[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
    memcpy(c, made, sizeof made);
}

static inline void applied(const double *m, const double *v, double *found) {
    for (int i = 0; i < 3; i++) found[i] = dot(m + 3 * i, v);
}

/* Rodrigues' formula, what is not a number to such; `rotation_matrix` */
static inline void matrix_of(const double *vector, double *m) {
    const double angle = sqrt(dot(vector, vector)), half = angle > 0 ? sin(angle / 2) / angle : angle + 0.5;
    const double s = angle > 0 ? sin(angle) / angle : angle + 1, c = 2 * half * half;
    for (int i = 0; i < 3; i++) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        m[4 * i] = 1 - c * (vector[j] * vector[j] + vector[k] * vector[k]);
        m[3 * i + j] = c * vector[i] * vector[j] - s * vector[k];
        m[3 * j + i] = c * vector[i] * vector[j] + s * vector[k];
    }
}

/* The quaternion w, x, y, z of a rotation, of any length: of four that are equal, one without cancellation, by Shepperd's
   method */
static inline void quaternion_of(const double *m, double *quaternion) {
    const double x = m[7] - m[5], y = m[2] - m[6], z = m[3] - m[1], xy = m[1] + m[3], yz = m[5] + m[7], zx = m[2] + m[6];
    const double columns[4][4] = {{1 + m[0] + m[4] + m[8], x, y, z}, {x, 1 + m[0] - m[4] - m[8], xy, zx},
                                  {y, xy, 1 - m[0] + m[4] - m[8], yz}, {z, zx, yz, 1 - m[0] - m[4] + m[8]}};
    int most = 0;
    for (int i = 1; i < 4; i++)
        if (columns[i][i] > columns[most][most]) most = i;
    memcpy(quaternion, columns[most], sizeof columns[most]);
}

/* The other way; `rotation_vector` */
static inline void vector_of(const double *m, double *vector) {
    double q[4];
    quaternion_of(m, q);
    const double size = sqrt(dot(q + 1, q + 1)), half = size > 0 ? atan2(size, fabs(q[0])) / size : 1 / fabs(q[0]);
    for (int k = 0; k < 3; k++) vector[k] = (q[0] < 0 ? -2 : 2) * half * q[1 + k];
}

/* Turns a matrix (3, 3), whose rows lie `width` apart, by Cayley's formula; `small_turn` */
static inline void turn(const double *by, double *rotation, int width) {
    const double half[3] = {by[0] / 2, by[1] / 2, by[2] / 2}, scale = 2 / (1 + dot(half, half));
    for (int j = 0; j < 3; j++) {
        const double old[3] = {rotation[j], rotation[width + j], rotation[2 * width + j]};
        double once[3], twice[3];
        cross(half, old, once);
        cross(half, once, twice);
        for (int k = 0; k < 3; k++) rotation[width * k + j] += scale * (once[k] + twice[k]);
    }
}

/* The triangle of Cholesky, in place, of the upper half of a matrix of n rows of `width`; whether there is one */
static inline int triangle(int n, int width, double *a) {
    for (int i = 0; i < n; i++) {
        double square = a[width * i + i];
        for (int k = 0; k < i; k++) square -= a[width * k + i] * a[width * k + i];
        if (!(square > 0)) return 0;
        a[width * i + i] = sqrt(square);
        for (int j = i + 1; j < n; j++) {
            double sum = a[width * i + j];
            for (int k = 0; k < i; k++) sum -= a[width * k + i] * a[width * k + j];
            a[width * i + j] = sum / a[width * i + i];
        }
    }
    return 1;
}

/* Solves with a triangle R: v becomes what R^T R sends to it */
static inline void solved(int n, int width, const double *a, double *v) {
    for (int i = 0; i < n; i++) {
        for (int k = 0; k < i; k++) v[i] -= a[width * k + i] * v[k];
        v[i] /= a[width * i + i];
    }
    for (int i = n - 1; i >= 0; i--) {
        for (int k = i + 1; k < n; k++) v[i] -= a[width * i + k] * v[k];
        v[i] /= a[width * i + i];
    }
}

#endif
