/* Camera geometry: one variant, for the instructions that it is compiled for.
 *
 * Rows go block by block; each step of a formula is a loop over a block, which the compiler makes vectors of. What lies
 * behind is alike for each point, wherever it stands: a block is filled up to whole vectors.
 * The templates are included for float and for double.
 */
#include "geometry.h"

#include <float.h>
#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#include "unit.h"

#define ALIGNED __attribute__((aligned(64)))

enum { LANES = 16 };      /* a block is filled up to a multiple of it */
enum { MOST_STEPS = 5 };  /* of Newton's method; what then still moves is left to brackets and searches */
enum { START_ROUNDS = 6, DAMPED_STEPS = 60 }; /* of a search */
enum { SQUARE = 64, PROBES = 5 }; /* pixels of a cell of a lattice; of these, where one in doubt is looked at */
enum { PADDED = 8 };      /* numbers of a factor that loops are made for */
#define PI 3.14159265358979323846

/* Over the points of a block; `n` is a multiple of LANES */
#define EACH(i) for (int i = 0; i < (n & -LANES); i++)

/* Charts that have loops of their own: unified ones of alpha 0, and of no xi those of alpha 1, of alpha 1/2, and others */
enum { SHIFTED = SPHERE + 1, SPHERICAL, HALFWAY, ENHANCED };
/* Factors that have: polynomials of few numbers and of some, and so on; any other one */
enum { FEW, SOME, RATIO, ROOTS, ANGLES, ALL, ANY };

/* The same loop for each chart, and for each factor: what differs is constant, and no branch is left in it */
#define CASE(name, ...) case name: { __VA_ARGS__; break; }
#define WAY(name, ...) CASE(name, enum { way = name }; __VA_ARGS__)
#define EACH_WAY(given, ...)                                                                                           \
    switch (given) {                                                                                                   \
        WAY(PERSPECTIVE, __VA_ARGS__) WAY(EQUIDISTANT, __VA_ARGS__) WAY(EQUISOLID, __VA_ARGS__)                        \
        WAY(UNIFIED, __VA_ARGS__) WAY(FOV, __VA_ARGS__) WAY(ONE_DIVISION, __VA_ARGS__) WAY(INVERTED, __VA_ARGS__)      \
        WAY(CYLINDER, __VA_ARGS__) WAY(SPHERE, __VA_ARGS__) WAY(SHIFTED, __VA_ARGS__) WAY(SPHERICAL, __VA_ARGS__)      \
        WAY(HALFWAY, __VA_ARGS__) WAY(ENHANCED, __VA_ARGS__)                                                           \
    }
#define FORM(name, made, n, m, ...) CASE(name, enum { kind = made, count = n, below = m }; __VA_ARGS__)
#define EACH_FORM(given, ...)                                                                                          \
    switch (given) {                                                                                                   \
        FORM(FEW, POLYNOMIAL, PADDED / 2, 0, __VA_ARGS__) FORM(SOME, POLYNOMIAL, PADDED, 0, __VA_ARGS__)               \
        FORM(RATIO, RATIONAL, PADDED / 2, PADDED / 2, __VA_ARGS__)                                                     \
        FORM(ROOTS, RADIUS_POLYNOMIAL, PADDED, 0, __VA_ARGS__) FORM(ANGLES, ANGLE_PER_RADIUS, PADDED, 0, __VA_ARGS__)  \
        FORM(ALL, ANGLE_OF_ALL_POWERS, PADDED, 0, __VA_ARGS__)                                                         \
    }

int32_t THIS(classify)(const Classification *);
void THIS(sample_images)(const Images *);

/* How many numbers a part has: the `parameters` of its chart or stage */
static int numbers_of(const Part *part) {
    int count = 0;
    if (part->kind == UNIFIED)
        count = !!(part->flags & HAS_XI) + !!(part->flags & HAS_ALPHA) + !!(part->flags & HAS_BETA);
    if (part->kind == FOV || part->kind == ONE_DIVISION) count = 1;
    if (part->kind == HOMOGRAPHY) count = 9;
    if (part->kind == SHEAR) count = 2;
    if (part->kind == SURFACE) count = 2 * part->n * part->m;
    if (part->kind == PLANAR) count = 2 * !!(part->flags & TANGENTIAL) + 4 * !!(part->flags & PRISM);
    if (part->factor == RADIUS_TABLE) return count + 4 * part->n;
    return part->factor == NO_FACTOR ? count : count + part->n + (part->factor == RATIONAL ? part->m : 0);
}

/* Adds to a number that threads share, and returns what it was */
static int64_t added(int64_t *number, int64_t count) { return __atomic_fetch_add(number, count, __ATOMIC_RELAXED); }

/* The next tile for a free thread */
static int64_t taken(int64_t *next, int64_t *own) { return next ? added(next, 1) : (*own)++; }

#define R float
#define I int32_t
#define T(name) name##_float
#define BLOCK 256
#define IS_DOUBLE 0
#define INVERSE_STEPS 1
#include "geometry_numbers.h"
#include "geometry_charts.h"
#include "geometry_lens.h"
#include "geometry_rows.h"
#include "geometry_search.h"
#include "geometry_moves.h"
#undef R
#undef I
#undef T
#undef BLOCK
#undef IS_DOUBLE
#undef INVERSE_STEPS

#define R double
#define I int64_t
#define T(name) name##_double
#define BLOCK 128
#define IS_DOUBLE 1
#define INVERSE_STEPS 2
#include "geometry_numbers.h"
#include "geometry_charts.h"
#include "geometry_lens.h"
#include "geometry_rows.h"
#include "geometry_search.h"
#include "geometry_moves.h"
#include "geometry_domain.h"

/* Takes tiles, of those that no thread has taken, until none is left; how many points wait for `limits2` */
int64_t THIS(geometry)(const Rows *rows) {
    return rows->cameras->is_double ? rows_double(rows) : rows_float(rows);
}

/* The same of pixels that are moved, and of lattices; flags of what is left */
int64_t THIS(moves)(const Move *move) { return move->from->is_double ? moves_double(move) : moves_float(move); }

int64_t THIS(lattices)(const Lattices *given) {
    return given->move.from->is_double ? lattices_double(given) : lattices_float(given);
}
