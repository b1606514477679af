/* The structures that Python passes to the search for poses. */
#ifndef CAMTORCH_POSES_H
#define CAMTORCH_POSES_H

#include <math.h>

#include "geometry.h"

/* From the rays alone, two poses a row; nearest to the pixels, from a pose; that, with all that comes before and after it:
   from nothing; from a pose, by the points near it */
enum { FROM_RAYS, REFINED, SOLVED, AGREED };
enum { LEAST_SQUARES, HUBER, CAUCHY };
#define LOST 1e3 /* px, that a point counts as which was seen and has no pixel */

/* Costs and weights of residuals of squared lengths; `robust` of calibration/bundle.py */
static inline double robust(int64_t loss, double scale, double square, double *weight) {
    const double c2 = scale * scale;
    if (loss == HUBER && square > c2) {
        const double length = sqrt(square);
        *weight = scale / length;
        return 2 * scale * length - c2;
    }
    *weight = loss == CAUCHY ? 1 / (1 + square / c2) : 1;
    return loss == CAUCHY ? c2 * log1p(square / c2) : square;
}

/* Rows (b) of n points; what a task has no use for is NULL */
typedef struct {
    const Cameras *cameras; /* (b), or one for all; in double precision */
    const double *points;   /* (point_rows, n, 3), over and over again */
    const double *rays, *pixels, *weights; /* (b, n, 3), (b, n, 2), (b, n): weights of squares, 0 for unseen */
    int64_t point_rows, row_count, count;
    int64_t task, loss, steps;
    double loss_scale, settled, nothing, damping;
    double threshold;                 /* px, of AGREED */
    double *rotations, *translations; /* (b, 9) and (b, 3); of FROM_RAYS (b, 2, 9) and (b, 2, 3) */
    uint8_t *valid;                   /* (b), or (b, 2): whether it is a pose, or a minimum */
    double *costs;                    /* (b) */
    /* of SOLVED and AGREED: rotation vectors (b, 3), root mean squares (b), which points the pose
       is of (b, n), and the covariance (b, 6, 6) of turn and shift */
    double *vectors, *rms;
    uint8_t *inliers;
    double *covariance;
    int64_t *next, *left; /* the next row that a free thread takes; how many points wait for limits of lenses */
} Poses;

/* Cameras (b) that see v views of n points each: residuals, and the linearised problem if it is asked for, whose columns are by
   turn and shift of the view, by numbers that learn, and the residuals; see least_squares/equations.py */
typedef struct {
    const Cameras *cameras; /* (b), or one for all; in double precision */
    const double *points;   /* (b, v, n, 3), strides by problem and view */
    int64_t point_strides[2];
    const double *rotations, *translations; /* (b, v, 9), (b, v, 3) */
    const double *pixels, *given; /* (b, v, n, 2), (b, v, n): the weights of squares, 0 for unseen */
    double *residuals, *weights;  /* (b, v, n, 2), (b, v, n) */
    uint8_t *valid;               /* (b, v, n) */
    double *costs;                /* (b, v) */
    int64_t problems, views, count, loss;
    double loss_scale;
    const int64_t *learnt; /* (columns): of intrinsics and parameters */
    int64_t columns;
    double *view, *shared; /* triangles (b, v, 6, 6 + columns + 1), (b, columns + 1, columns + 1), or NULL */
    int64_t *left;         /* how many points wait for limits of lenses; -1: no memory */
} Views;

/* Damped steps of such problems, of views with so many unknowns; `System.step` there */
typedef struct {
    const double *view, *shared; /* (b, v, width, width + columns + 1), (b, columns + 1, columns + 1) */
    const double *damping;       /* (b) */
    int64_t problems, views, width, columns;
    double *of_views, *of_shared, *rest; /* (b, v, width), (b, columns), (b): what a step leaves of the decrement */
    int64_t *left;                       /* -1: no memory */
} Steps;

#endif
