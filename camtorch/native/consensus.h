/* The structure that Python passes to the search for poses among outliers. */
#ifndef CAMTORCH_CONSENSUS_H
#define CAMTORCH_CONSENSUS_H

#include "small.h"

typedef struct {
    const double *points, *measures; /* (b, 3, n), (b, 3, 3, n) */
    const int64_t *order, *counts;   /* (b, n), those seen first; how many they are, (b) */
    const double *numbers;           /* (samples, 3) in [0, 1) */
    double *best, *costs;            /* (b, 3, 4), (b), so far */
    int64_t *agree;                  /* (b): points near the best */
    const int64_t *rows;             /* those that go on */
    int64_t row_count, count, samples;
    double most;   /* the threshold's square */
    int64_t *next; /* the next row that a free thread takes */
} Agreement;

#ifdef VARIANT
int THIS(poses_of_three)(double points[3][3], double rays[3][3], double poses[4][12]);
#endif

#endif
