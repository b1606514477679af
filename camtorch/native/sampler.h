/* The structures that Python passes to the sampler, plain pointers and sizes; headers.py writes them to structs.py. */
#ifndef CAMTORCH_SAMPLER_H
#define CAMTORCH_SAMPLER_H

#include <stdint.h>

#include "glibc.h"

#if defined(_MSC_VER)
#define EXPORTED __declspec(dllexport)
#else
#define EXPORTED __attribute__((visibility("default")))
#endif

/* NEAREST moves whole elements of 1, 2, 4 or 8 bytes; UINT8 and so on are computed with */
enum { UINT8, BOOL, UINT16, FLOAT32, BYTES1, BYTES2, BYTES4, BYTES8, TYPES };
enum { NEAREST, BILINEAR, BICUBIC };
enum { ZEROS, BORDER, REFLECTION };

enum { SCRATCH = 25 };
enum { STEP = 8 }; /* pixels between the nodes of a lattice */
/* quintics do there, which are to be laid; cubics may miss; to be computed next; and others that have no place in `exact` */
enum { CELL_QUINTIC = -5, CELL_DOUBT, CELL_NEXT, CELL_EMPTY, CELL_CUBIC, CELL_TODO };
#define CELL_MISSED 0.0703125f /* of fourth differences of nodes, by which cubics may miss the middle of a cell: 3 / 128 of even
                                  ones, and three times that, as differences tell less at a step of the curvature */
#define CELL_MARGIN 0.05f      /* of half an image: what lies beyond is not sampled */
#define CELL_OVERSHOOT 0.5f    /* of the range of its nodes by which a cubic may leave it: 0.27 along each axis */
#define CELL_OFF 4.0f          /* pixels by which cells that may be left out are off the image: two would do */

typedef struct {
    /* images (b, c, y, x) and results, in elements; a source image may serve all results (stride 0) */
    const void *source;
    void *result;
    int64_t source_strides[4], result_strides[4];
    int64_t count, channels, source_height, source_width, height, width;
    /* the value of pixels that show nothing, one for each channel: to be blended, and as an element */
    const float *fill;
    const void *fill_elements;
    /* positions as of grid_sample, one for each pixel, (b, y, x, component); or NULL */
    const void *grid;
    int64_t grid_strides[4];
    int64_t grid_is_double;
    const uint8_t *mapped; /* (b, y, x) without gaps in y, x: whether there is a position; NULL: read from positions */
    int64_t mapped_stride;
    /* or on a lattice: (b, component, rows + 5, columns + 5) nodes, (b, rows, columns) cells, (component, cell, 8, 8) */
    const float *nodes;
    int64_t node_strides[2];
    const int32_t *cells;
    int64_t cell_stride, rows, columns;
    const float *exact;
    int64_t exact_stride;
    int32_t type, mode, padding;
    int32_t tile_rows;
    int64_t next; /* the next tile that a free thread takes */
} Job;

/* Images of one size, of which each shows the same positions of a lattice */
typedef struct {
    const Job *jobs;
    int64_t count, image; /* how many; which one of each job */
} Images;

typedef struct {
    /* positions as of grid_sample of nodes (b, component, rows + 5, columns + 5), whether they are mapped (b, same), */
    const float *nodes;
    int64_t node_strides[2];
    const uint8_t *mapped;
    int64_t mapped_stride;
    /* and whether the pixels at the rim of the target are: (b, top row, bottom row, left column, right column) */
    const uint8_t *rim;
    int64_t rim_stride;
    int64_t count, rows, columns, height, width;
    double source_height, source_width, tolerance;
    int32_t padding; /* that is to be sampled with: what lies off the image then matters, or does not */
    /* (b, rows, columns): CELL_EMPTY, CELL_CUBIC, CELL_DOUBT, or CELL_TODO where positions are to be exact */
    int32_t *cells;
    float *scratch; /* SCRATCH (columns + 8), and of lattices as often as there are */
} Classification;

/* The positions of pixels by a lattice; or what is transposed: the gradients of its nodes and exact positions by theirs */
typedef struct {
    /* (b, component, rows + 5, columns + 5), (b, rows, columns), (component, cell, 8, 8): as of `Job`, without gaps; cells
       may be CELL_QUINTIC */
    float *nodes;
    const int32_t *cells;
    float *exact;
    int64_t exact_count;
    float *grid;     /* (b, y, x, component), without gaps */
    uint8_t *mapped; /* (b, y, x): whether there is a position; not of gradients */
    int64_t count, rows, columns, height, width;
    int64_t is_transposed; /* nodes are then zeros at first */
    int64_t next;          /* the next strip, or if it is transposed camera, that a free thread takes */
} Laying;

#endif
