/* Linear algebra of few numbers. Matrices are rows after rows. */
#ifndef CAMTORCH_SMALL_H
#define CAMTORCH_SMALL_H

#include <math.h>
#include <stdint.h>
#include <string.h>

/* A name of the variant that is compiled */
#define NAMED(name, variant) name##_##variant
#define EXPANDED(name, variant) NAMED(name, variant)
#define THIS(name) EXPANDED(name, VARIANT)

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
