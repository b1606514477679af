/* What Python passes to the geometry: codes of what optics are made of, numbers, rows.
 *
 * The formulas are those of camtorch/optics, named alike there, and their sources stand there.
 */
#ifndef CAMTORCH_GEOMETRY_H
#define CAMTORCH_GEOMETRY_H

#include <stdint.h>

#include "sampler.h"

/* Charts: rays to a plane; the numbers of each are its `parameters` */
enum { PERSPECTIVE, EQUIDISTANT, EQUISOLID, UNIFIED, FOV, ONE_DIVISION, INVERTED, CYLINDER, SPHERE };
/* Flags of charts: which of xi, alpha, beta are numbers, and whether x and y change places */
enum { HAS_XI = 1, HAS_ALPHA = 2, HAS_BETA = 4, TRANSVERSE = 8 };

/* Stages of a lens on that plane */
enum { PLANAR = 16, HOMOGRAPHY, SHEAR, SURFACE };
/* Flags of the planar stage; those of a surface of n x m control points are its order */
enum { TANGENTIAL = 1, PRISM = 2 };

/* Radial factors, of the planar stage and of the inverted chart; n numbers each, n + m the ratio, 4 n the table */
enum { NO_FACTOR, POLYNOMIAL, RATIONAL, RADIUS_POLYNOMIAL, ANGLE_PER_RADIUS, ANGLE_OF_ALL_POWERS, RADIUS_TABLE };

enum { MOST_PARTS = 5 };
enum { MOST_DEGREE = 64 }; /* of a polynomial whose root is asked for, and of a ratio's denominator */
enum { NODES = 1024 };   /* of the table of an inverse, see `radial_inverse.tabulate` */
enum { MOST_RADII = 512 }; /* on which a lens is followed outwards by bounds of its stages */
enum { AZIMUTHS = 336 }; /* on which limits are given, see `fold.limits_and_extent` */
enum { RADII = 80 };     /* on each of them: half over the whole chart, half around the fold of a radial factor */
enum { DIP = 65 };       /* radii at which a dip between two of them is sampled */
#define SMOOTH 0.02 /* by how much a fold may differ from one azimuth to the next, and how far it bulges between them, if so */
#define BULGE 0.001
#define FAR_IMAGE 20.0 /* focal lengths: no image goes further, and there lenses may differ much between two azimuths */
#define BEYOND 1.01    /* what an extent allows for outside of its rim and, in azimuths, next to it */
enum { ASIDE = 4 };
enum { SPAN = 12 }; /* azimuths that the rim may go on from one to the next, and next to it; else it is a circle */
/* Radii (RADII); how far out they are sent on each azimuth (AZIMUTHS, RADII), ascending; how far the image reaches in each
   direction (AZIMUTHS) */
enum { EXTENT = RADII + AZIMUTHS * RADII + AZIMUTHS };

/* A chart or a stage */
typedef struct {
    int32_t kind, flags, factor, n, m;
    double constant; /* alpha of a unified chart that does not learn it; cells past its edge that belong to a surface */
    double cells[2], centre[2]; /* of a surface: how many lie on a unit of a and of b; its middle */
} Part;

/* Cameras (c) of one model. Pointers are to numbers of one type, float or double, without gaps */
typedef struct {
    const Part *parts; /* the chart, then the stages */
    int64_t part_count, is_double, cameras;
    const void *intrinsics; /* (c, 4) */
    const void *parameters; /* (c, parameter_count): of all parts, in their order */
    int64_t parameter_count;
    const void *constants;  /* (c, constant_count): the nodes of a table, n + 1 */
    int64_t constant_count;
    const uint8_t *usable; /* (c), or NULL: all are. The numbers of one that is not are those of any that is */
    /* of a lens: squared radii up to which it is regular, and no further out than images reach; squared limits (c,
       AZIMUTHS) and where it sends azimuths (c, EXTENT), or NULL: not yet known; tables of the inverse
       (c, 2 + 2 NODES), or NULL; whether it goes stage by stage (c), or NULL: none; the squared radius (c) of the circle
       that its image lies in then */
    const void *safe_radius_sq, *image_radius_sq, *limits2, *extent, *table;
    const uint8_t *stagewise;
    const void *image_circle_sq;
    /* of an inverted chart: the squared radius and the squared angle of its fold, the table of its inverse */
    const void *chart_safe_radius_sq, *chart_most2, *chart_table;
} Cameras;

/* One of several cameras, or the one for all */
static inline Cameras only(const Cameras *all, int64_t at) {
    Cameras one = *all;
    if (all->cameras == 1) return one;
    one.cameras = 1;
    const int64_t width = all->is_double ? sizeof(double) : sizeof(float);
#define MOVED(field, size) if (one.field) one.field = (const void *)((const char *)one.field + at * (size) * width)
    MOVED(intrinsics, 4);
    MOVED(parameters, all->parameter_count);
    MOVED(constants, all->constant_count);
    MOVED(safe_radius_sq, 1);
    MOVED(image_radius_sq, 1);
    MOVED(limits2, AZIMUTHS);
    MOVED(extent, EXTENT);
    MOVED(table, 2 + 2 * NODES);
    MOVED(image_circle_sq, 1);
    MOVED(chart_safe_radius_sq, 1);
    MOVED(chart_most2, 1);
    MOVED(chart_table, 2 + 2 * NODES);
#undef MOVED
    if (one.usable) one.usable += at;
    if (one.stagewise) one.stagewise += at;
    return one;
}

/* What is asked for of lenses (c), or of the factors of inverted charts; what is not wanted is NULL. Results are float
   or double */
typedef struct {
    const Part *parts; /* as of `Cameras` */
    int64_t part_count, is_double, cameras;
    const double *parameters; /* (c, parameter_count) */
    int64_t parameter_count;
    const double *constants; /* (c, constant_count) */
    int64_t constant_count;
    int64_t is_chart, is_radial;     /* whether the factor is an inverted chart's; whether the lens is a factor alone */
    const double *ends, *usual_ends; /* (c): the radius at which the chart ends, and beyond which there are no images;
                                        NULL: those of a unified chart, by its parameters */
    const double *folds;             /* (c): of factors whose fold is not the root of a polynomial, or NULL */
    double most;                     /* the largest image that is a number to calculate with */
    const double *radii;             /* (MOST_RADII): from the centre to the end of the chart */
    const double *coarse, *even;     /* (RADII / 2), (RADII): the same, of `limits2` and `extent` */
    void *safe_radius_sq, *image_radius_sq, *image_circle_sq, *table; /* (c), (c), (c), (c, 2 + 2 NODES); see `Cameras` */
    void *limits2, *extent;                  /* (c, AZIMUTHS), (c, EXTENT): both or none */
    uint8_t *stagewise;                      /* (c); with image_circle_sq */
} Domain;

enum { PROJECT, UNPROJECT, PROJECT_VJP, UNPROJECT_VJP };

/* Rows (c, n), strides in elements by camera, point and component; what is not wanted is NULL */
typedef struct {
    const Cameras *cameras;
    const void *rows; /* points or pixels; */
    int64_t row_strides[3];
    void *results; /* pixels or rays; of a vjp, the cotangents of points or pixels */
    int64_t result_strides[3];
    uint8_t *valid; /* (c, n) without gaps; the vjp of unproject reads it */
    void *solution; /* (2, c, n) without gaps: points on the chart's plane, which the vjp of unproject reads */
    const void *cotangents; /* of pixels or rays */
    int64_t cotangent_strides[3];
    /* (c, tiles, 4 + parameter_count): the sums over a tile of the cotangents of intrinsics and parameters */
    double *sums;
    int64_t count, tile; /* points of a camera; of a tile */
    int64_t direction;
    int64_t *next; /* the next tile that a free thread takes; NULL: one thread takes all */
} Rows;

/* What is made of pixels that are moved: positions as of grid_sample, OUTSIDE where there is none; or pixels, -1 there, of
   which ON_IMAGE leaves those on the image of `to` valid alone. Of BOXES (n, 4), the boxes that enclose their moved outlines */
enum { POSITIONS, PIXELS, ON_IMAGE, BOXES };
enum { EDGE_POINTS = 64 }; /* along a side of a box; warp/boxes.py */
/* What is left to do: pixels wait for the extent of `from`, points for the limits of `to`; most cells of a lattice want
   exact positions; or some box takes more than its outline, some pose has no rotation */
enum { LEFT_FROM = 1, LEFT_TO = 2, LEFT_MOST = 4, LEFT_LABELS = 8 };
#define OUTSIDE -9.0f /* a position that no image reaches, not even with its interpolation margin */
#define FAR 100.0f    /* positions beyond are clamped to it: grid_sample casts them to integers */

/* Pixels of cameras `from`, by rays that are turned, to those of `to`; each as many as `cameras`, or one for all. All
   numbers are of the type of both */
typedef struct {
    const Cameras *from, *to;
    const void *turns;   /* (c, 3, 3), or NULL */
    int64_t turn_strides[3]; /* by camera, 0 for one that serves all; by row and column */
    int64_t cameras, form;
    double height, width; /* of the image of `to` */
    const void *rows;     /* pixels (c, n) and results, strides as of `Rows` */
    int64_t row_strides[3];
    void *results;
    int64_t result_strides[3];
    uint8_t *valid;      /* (c, n) without gaps */
    int64_t count, tile; /* pixels of a camera; of a tile */
    int64_t *next;       /* the next tile, or camera of lattices, that a free thread takes */
} Move;

/* Lattices (c): `move` is of their nodes and of the pixels at the rim, in planes, and `cells` what is asked of them; both
   are those of the first camera */
typedef struct {
    Move move;
    Classification cells;
    int64_t first_row; /* of the target, where cells begin */
    int64_t learns; /* CELL_QUINTIC stays in `cells`, without a place in `exact`, where few cells may have one */
    float *narrow;     /* (c, 2, nodes), the nodes in float; NULL if they are so already */
    /* (2, c rows columns, 8, 8): positions of all pixels of the cells that `classify` leaves, NaN where there is none,
       and of those around a cell in which what is mapped ends. Each cell gets the number of its place there */
    void *exact;
    int64_t *used; /* how many places of `exact` are used */
    const Job *jobs; /* images (c) that are sampled, each as soon as its lattice is there; none where `exact` is double */
    int64_t job_count;
} Lattices;

enum { SQUARES = STEP * STEP }; /* positions in a cell */
enum { LEFT_BITS = 4 }; /* flags of pixels and vectors stand so much higher than those of the lattice */

/* What turns: vectors, NaN where one is not finite, of which the first three of a POSE are the columns of a rotation; or
   vectors of rotations, of which a turn by nothing leaves the bits */
enum { RAYS, POSE, ROTATION_VECTORS };

/* Vectors of three numbers that turn, of the type of the rotation */
typedef struct {
    const void *turn; /* (3, 3); NULL: they stay */
    const void *rows;
    void *results;      /* rows, until they turn */
    int64_t strides[2]; /* of both, by vector and component */
    int64_t count, is_double, form;
} Turned;
#define NEARLY_ROTATION 1e-3 /* the largest deviation of R R^T from the identity */

/* A sample: a lattice of one camera, images that are sampled on it, whole or by other calls, pixels that move, and
   vectors; or the pixels of a batch */
typedef struct {
    const Job *jobs;
    int64_t job_count, is_whole; /* 0: others sample the images */
    const Move *moves;
    int64_t move_count;
    const Turned *turned;
    int64_t turned_count;
    Lattices lattices;
} Together;

#endif
