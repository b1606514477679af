/* The structure that Python passes to `draws`, which makes cameras of drawn values. */
#ifndef CAMTORCH_DRAWS_H
#define CAMTORCH_DRAWS_H

#include "geometry.h"

/* Kinds of values that are drawn of a camera; of CENTRE and PLACE two, of DISTORTION as many as AMOUNTS, else one */
enum { YAW, PITCH, ROLL, ZOOM, WIDTH, FOCAL, CENTRE, DISTORTION, CROP, PLACE, DRAWN_KINDS };
enum { AMOUNTS = 16 };
enum { TRIES = 8 }; /* of steps of the coefficients, before they stay as they are */
#define JITTER_PARTS 1.0, -1.0, 0.5, -0.5, 0.25, -0.25, 0.125, -0.125 /* of a step, in the order in which they are tried */
#define TO_FOLD 0.98 /* of the image's radius at the fold: closer to it a pixel is many degrees wide */
enum { RIM = 128 }; /* pixels along the edges of the image, and points of the plane along the end of a lens */
/* What is left to do: the limits of azimuths of the base, new lenses and the source, and the ends of the base; or why there are no
   cameras: the lens does not reach that far, and a focal length is not positive, or a number not finite */
enum { LEFT_BASE = 1, LEFT_LENS = 2, LEFT_ENDS = 4, TOO_WIDE = 8, NO_CAMERA = 16, LEFT_SOURCE = 32 };
enum { SPREAD = 1000, LOOKED_AT = SPREAD + 64 }; /* pixels of a new image that are looked at, those of its rim at the end */
#define NEARLY_FILLED 0.999 /* at most, if the rim shows something else */
#define MOST_ZOOM 4.0       /* before the camera turns back */
#define FAR_ZOOM 1000.0     /* of a camera that is not turned */
#define TURN_PARTS 1.0, 0.5, 0.25, 0.0 /* of its turn that are left, in the order in which they are tried */
enum { HALVINGS = 10 }; /* of the interval in which the zoom lies */

/* Cameras (c) like others that move by drawn values. What is not wanted is NULL; numbers whose type is void are of that of
   the cameras */
typedef struct {
    const double *values;        /* kind after kind, of each (c) or (c, size) */
    int64_t first[DRAWN_KINDS];  /* how many values of a camera come before those of a kind; -1: it is not drawn */
    int64_t cameras, count;      /* count: of coefficients */
    double height, width;        /* of the new image */
    int64_t is_each;             /* whether what follows up to `ends` is (c, ...), or one for all */
    const double *sized;         /* (4): intrinsics of the base before the new image */
    const double *reach;         /* how far out the base sends the place where it folds, in focal lengths */
    const void *coefficients;    /* (count) of the base */
    const double *sensitivity;   /* (count): by how much to change each, so that the rim moves from centre to corner */
    const double *ends;          /* (RIM, 2): where the base ends, in focal lengths; NULL: not yet known */
    const Cameras *base;         /* (c), or one for all, with its own intrinsics */
    const void *border;          /* (RIM, 2): pixels */
    const int64_t *places;       /* which coefficients the parameters of a new lens are; NULL: none is made here */
    Domain domain;               /* of one new lens: what is asked, without its parameters and results */
    const Cameras *tries;        /* (c TRIES): new lenses that were made elsewhere, and their (count) coefficients; or NULL */
    const void *tried;
    const uint8_t *allowed;      /* (c TRIES): which of those have a formula; NULL: all */
    double share;                /* of each new image that has to show something of the source; 0: none has to */
    const Cameras *source;       /* (c), or one for all, of images of that size */
    double source_height, source_width;
    const void *looked_at;       /* (LOOKED_AT, 2): pixels */
    double *factors, *filled;    /* (c): on the focal lengths, for that, and the share that is filled */
    void *room;                  /* for all that is made: of each camera 4 + 9 + count numbers, and, if `places` are given,
                                    its parameters, 4, and a table */
    Cameras made;                /* the new cameras; as given, what else the base has of its lens, which a new one then has */
    void *rotations, *distortion; /* (c, 9) and (c, count), in `room` */
    int64_t followed;            /* of how many new lenses `limits2` and `extent` are */
} Draws;

#endif
