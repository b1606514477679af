/* The structures that Python passes to `draws`, which makes cameras of drawn values. */
#ifndef CAMTORCH_DRAWS_H
#define CAMTORCH_DRAWS_H

#include "geometry.h"

enum { AMOUNTS = 16 }; /* of coefficients: with more of them, the first amount is again that of the next, and so on */
enum { TRIES = 8 }; /* of steps of the coefficients, before they stay as they are */
#define JITTER_PARTS 1.0, -1.0, 0.5, -0.5, 0.25, -0.25, 0.125, -0.125 /* of a step, in the order in which they are tried */
#define TO_FOLD 0.98 /* of the image's radius at the fold: closer to it a pixel is many degrees wide */
enum { RIM = 128 }; /* pixels along the edges of the image, and points of the plane along the end of a lens */
/* What is left to do: the limits of azimuths of the base and of the source, and the ends of the base; or why there are no
   cameras: the lens does not reach that far, and a focal length is not positive, or a number not finite */
enum { LEFT_BASE = 1, LEFT_SOURCE = 2, LEFT_ENDS = 4, TOO_WIDE = 8, NO_CAMERA = 16 };
enum { SPREAD = 1000, LOOKED_AT = SPREAD + 64 }; /* pixels of a new image that are looked at, those of its rim at the end */
#define NEARLY_FILLED 0.999 /* at most, if the rim shows something else */
#define MOST_ZOOM 4.0       /* before the camera turns back */
#define FAR_ZOOM 1000.0     /* of a camera that is not turned */
#define TURN_PARTS 1.0, 0.5, 0.25, 0.0 /* of its turn that are left, in the order in which they are tried */
enum { HALVINGS = 10 }; /* of the interval in which the zoom lies */

/* What is drawn for a camera, by the names of ranges; of what is not drawn, the number that changes nothing */
typedef struct {
    double yaw, pitch, roll, zoom;
    double fov; /* 0: not drawn */
    double focal, centre[2], distortion[AMOUNTS], crop, place[2];
} Drawn;

/* What all draws from the same cameras share. What is not wanted is NULL; numbers whose type is void are of that of the
   cameras */
typedef struct {
    double height, width;        /* of the new image */
    int64_t count;               /* of coefficients */
    int64_t is_each;             /* whether what follows up to `ends` is (c, ...), or one for all */
    const double *sized;         /* (4): intrinsics of the base before the new image */
    const double *reach;         /* how far out the base sends the place where it folds, in focal lengths */
    const void *coefficients;    /* (count) of the base */
    const double *sensitivity;   /* (count): by how much to change each, so that the rim moves from centre to corner */
    const double *ends;          /* (RIM, 2): where the base ends, in focal lengths; NULL: not yet known */
    const Cameras *base;         /* (c), or one for all, with its own intrinsics */
    const int64_t *places;       /* which coefficients the parameters of a new lens are; NULL: new cameras have the base's lens */
    const void *border;          /* (RIM, 2): pixels, of new lenses */
    Domain domain;               /* of one new lens: what is asked, without its parameters and results */
    double share;                /* of each new image that has to show something of the source; 0: none has to */
    const Cameras *source;       /* (c), or one for all, of images of that size */
    double source_height, source_width;
    const void *looked_at;       /* (LOOKED_AT, 2): pixels */
} Start;

/* New cameras (c), like the base but for what is drawn */
typedef struct {
    const Start *start;
    const Drawn *drawn; /* (c) */
    int64_t cameras;
    void *room;   /* memory for intrinsics (c, 4), rotations (c, 9) and coefficients (c, count), then for the rest of new lenses:
                     their (c, parameter_count) parameters, (c, 4) numbers of their domain, and tables (c, 2 + 2 NODES) */
    void *limits; /* memory for (c, AZIMUTHS + EXTENT) of new lenses, if a point far out can ask for limits of azimuths */
    double *factors, *filled; /* (c): on the focal lengths, for `share`, and what is filled then */
    Cameras made; /* the new cameras, in that memory; without limits unless all new lenses have them */
    void *rotations, *distortion; /* in `room` */
    int64_t followed;             /* how many new lenses have limits */
} Draws;

#endif
