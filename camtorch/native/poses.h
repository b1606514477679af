/* What Python hands to the search for poses. calibration/compiled.py has the same fields. */
#ifndef CAMTORCH_POSES_H
#define CAMTORCH_POSES_H

#include "geometry.h"

/* From the rays alone, two poses a row; nearest to the pixels, from a pose; that, with all that comes before and after it:
   from nothing; from a pose, by the points near it */
enum { FROM_RAYS, REFINED, SOLVED, AGREED };
enum { LEAST_SQUARES, HUBER, CAUCHY };

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
    int64_t *next, *left; /* the row that whoever is free takes; how many points wait for what is known of lenses */
} Poses;

#endif
