/* Poses of known points: from the rays that see them, and nearest to their pixels. The formulas are those of
 * camtorch/calibration/rays.py and pnp.py, named alike there, and their sources stand there. */
#include <float.h>
#include <stdlib.h>

#include "consensus.h"
#include "views.h"

#define FLAT 1e-6
#define SAME_TRACE 2.9996000133332 /* 1 + 2 cos(0.02) */
#define LEAST 1e-15
#define TINY 1e-300
#define MOST_DAMPING 1e8
#define LEAST_DAMPING 1e-15
#define THIN 0.1
#define LINE 1e-6
#define WORSE 4.0
enum { ONE_STEP = 97 }; /* `numbers_of_step` of one view */
enum { BEGUN = 12, FEW_BEGUN = 4, STEPS = 8, FEW = 5, FEW_STEPS = 8, TURNS = 24, ROUNDS = 8 };

static void normalized(double *v) {
    const double length = sqrt(dot(v, v)), by = 1 / (length > 1e-12 ? length : 1e-12);
    for (int k = 0; k < 3; k++) v[k] *= by;
}

static double trace_of_turn(const double *a, const double *b) { return dot(a, b) + dot(a + 3, b + 3) + dot(a + 6, b + 6); }

/* Eigenvalues, ascending, and vectors (in rows) of a symmetric matrix of n <= 4, which is lost: by Jacobi's rotations */
static void eigen(int n, double *a, double *values, double *vectors) {
    double axes[16] = {0};
    for (int i = 0; i < n; i++) axes[n * i + i] = 1;
    for (int sweep = 0; sweep < 30; sweep++) {
        double off = 0, size = 0;
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) *(i == j ? &size : &off) += a[n * i + j] * a[n * i + j];
        if (!(off > 1e-32 * size)) break;
        for (int p = 0; p < n; p++)
            for (int q = p + 1; q < n; q++) {
                if (a[n * p + q] == 0) continue;
                const double theta = (a[n * q + q] - a[n * p + p]) / (2 * a[n * p + q]);
                const double t = (theta < 0 ? -1 : 1) / (fabs(theta) + sqrt(theta * theta + 1));
                const double c = 1 / sqrt(t * t + 1), s = t * c;
                for (int k = 0; k < n; k++) {
                    const double x = a[n * k + p], y = a[n * k + q];
                    a[n * k + p] = c * x - s * y, a[n * k + q] = s * x + c * y;
                }
                for (int k = 0; k < n; k++) {
                    const double x = a[n * p + k], y = a[n * q + k], u = axes[n * p + k], v = axes[n * q + k];
                    a[n * p + k] = c * x - s * y, a[n * q + k] = s * x + c * y;
                    axes[n * p + k] = c * u - s * v, axes[n * q + k] = s * u + c * v;
                }
            }
    }
    for (int i = 0, used = 0; i < n; i++) {
        int least = -1;
        for (int j = 0; j < n; j++)
            if (!(used >> j & 1) && (least < 0 || a[n * j + j] < a[n * least + least])) least = j;
        used |= 1 << least, values[i] = a[n * least + least];
        memcpy(vectors + n * i, axes + n * least, (size_t)n * sizeof(double));
    }
}

/* The eigenvector of the least eigenvalue of a matrix without negative ones, n <= 9, which is lost: by steps of the inverse */
static void least_eigenvector(int n, double *a, double *v) {
    double size = 0;
    for (int k = 0; k < n; k++) size += a[(n + 1) * k], v[k] = 1 + 0.1 * k;
    for (int k = 0; k < n; k++) a[(n + 1) * k] += 1e-14 * size + TINY;
    const int fine = triangle(n, n, a);
    for (int step = 0; fine && step < 30; step++) {
        double old[9], square = 0, cosine = 0;
        memcpy(old, v, (size_t)n * sizeof *old);
        solved(n, n, a, v);
        for (int k = 0; k < n; k++) square += v[k] * v[k];
        for (int k = 0; k < n; k++) v[k] /= sqrt(square), cosine += v[k] * old[k];
        if (1 - cosine < 1e-14) break;
    }
}

/* A rotation whose third column is a direction */
static void frame_of(const double *direction, double *found) {
    const double sign = direction[2] < 0 ? -1 : 1;
    const double mirror[3] = {direction[0], direction[1], direction[2] + sign}, square = dot(mirror, mirror);
    const double scale = 2 / (square > TINY ? square : TINY);
    double first[3], second[3];
    for (int k = 0; k < 3; k++) first[k] = (k == 0) - scale * mirror[0] * mirror[k];
    cross(direction, first, second);
    for (int k = 0; k < 3; k++) found[3 * k] = first[k], found[3 * k + 1] = second[k], found[3 * k + 2] = direction[k];
}

/* The rotation nearest to a matrix: that of the largest eigenvector of Horn's form of quaternions */
static void nearest_rotation(const double *m, double *found) {
    double values[4], v[16], form[16] = {
        m[0] + m[4] + m[8], m[7] - m[5], m[2] - m[6], m[3] - m[1], m[7] - m[5], m[0] - m[4] - m[8], m[1] + m[3], m[2] + m[6],
        m[2] - m[6], m[1] + m[3], m[4] - m[0] - m[8], m[5] + m[7], m[3] - m[1], m[2] + m[6], m[5] + m[7], m[8] - m[0] - m[4]};
    eigen(4, form, values, v);
    const double w = v[12], x = v[13], y = v[14], z = v[15];
    const double made[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
    memcpy(found, made, sizeof made);
}

/* The sum of the squared distances of points from rays as a form of a rotation's entries; `_Distances` */
typedef struct {
    double form[9][9], to_translation[3][9], to_depth[9], toward[3]; /* the sum of the rays */
} Distances;

static void between(const double *local, const double *rays, const double *weights, int64_t count, Distances *d) {
    static const int pair[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};
    double pairs[6][6] = {{0}}, of_points[6] = {0}, of_rays[6] = {0}, along[6][3] = {{0}}, mixed[9] = {0};
    double middle[3] = {0}, all = 0, total[9];
    memset(d->toward, 0, sizeof d->toward);
    for (int64_t i = 0; i < count; i++) {
        const double w = weights[i], *p = local + 3 * i, *r = rays + 3 * i;
        if (w == 0) continue;
        const double pp[6] = {w * p[0] * p[0], w * p[0] * p[1], w * p[0] * p[2], w * p[1] * p[1], w * p[1] * p[2], w * p[2] * p[2]};
        const double rr[6] = {r[0] * r[0], r[0] * r[1], r[0] * r[2], r[1] * r[1], r[1] * r[2], r[2] * r[2]};
        for (int a = 0; a < 6; a++) {
            for (int b = 0; b < 6; b++) pairs[a][b] += rr[a] * pp[b];
            for (int b = 0; b < 3; b++) along[a][b] += rr[a] * (w * p[b]);
            of_points[a] += pp[a], of_rays[a] += w * rr[a];
        }
        for (int a = 0; a < 3; a++) {
            for (int b = 0; b < 3; b++) mixed[3 * a + b] += w * r[a] * p[b];
            middle[a] += w * p[a], d->toward[a] += w * r[a];
        }
        all += w;
    }
    for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++) total[3 * a + b] = (a == b) * (all + LEAST) - of_rays[pair[a][b]];
    double moved[3][9], solution[9][3];
    const int fine = triangle(3, 3, total);
    for (int k = 0; k < 9; k++) {
        for (int a = 0; a < 3; a++) {
            moved[a][k] = (a == k / 3) * middle[k % 3] - along[pair[a][k / 3]][k % 3];
            solution[k][a] = fine ? moved[a][k] : NAN;
        }
        solved(3, 3, total, solution[k]);
    }
    for (int k = 0; k < 9; k++) {
        for (int j = 0; j < 9; j++) {
            const int across = k / 3 == j / 3, p = pair[k % 3][j % 3];
            d->form[k][j] = across * of_points[p] - pairs[pair[k / 3][j / 3]][p];
            for (int a = 0; a < 3; a++) d->form[k][j] -= moved[a][k] * solution[j][a];
        }
        for (int a = 0; a < 3; a++) d->to_translation[a][k] = -solution[k][a];
        d->to_depth[k] = mixed[k] - dot(d->toward, solution[k]);
    }
}

static double product9(const double *a, const double *b) {
    double sum = 0;
    for (int k = 0; k < 9; k++) sum += a[k] * b[k];
    return sum;
}

static void mapped9(const Distances *d, const double *v, double *found) {
    memset(found, 0, 9 * sizeof *found);
    for (int k = 0; k < 9; k++)
        for (int j = 0; j < 9; j++) found[j] += d->form[k][j] * v[k];
}

static double of_rotation(const Distances *d, const double *rotation) {
    double found[9];
    mapped9(d, rotation, found);
    return product9(found, rotation);
}

/* A rotation after some steps of Levenberg and Marquardt */
static void descend(const Distances *d, double *rotation, int steps) {
    double cost = of_rotation(d, rotation), damping = 1e-2, normal[9], gradient[3], slopes[3][9], mapped[3][9];
    for (int step = 0, is_new = 1; step < steps; step++) {
        for (int k = 0; k < 3 && is_new; k++) {
            const int i = (k + 1) % 3, j = (k + 2) % 3;
            for (int b = 0; b < 3; b++)
                slopes[k][3 * k + b] = 0, slopes[k][3 * i + b] = -rotation[3 * j + b], slopes[k][3 * j + b] = rotation[3 * i + b];
            mapped9(d, slopes[k], mapped[k]);
            gradient[k] = product9(mapped[k], rotation);
        }
        double by[3], damped[9], turned[9];
        for (int k = 0; k < 3; k++)
            for (int j = 0; j < 3; j++) normal[3 * k + j] = is_new ? product9(mapped[k], slopes[j]) : normal[3 * k + j];
        memcpy(damped, normal, sizeof damped);
        for (int k = 0; k < 3; k++) damped[4 * k] += damping * (normal[0] + normal[4] + normal[8]) + TINY, by[k] = -gradient[k];
        is_new = 0;
        if (triangle(3, 3, damped)) {
            solved(3, 3, damped, by);
            memcpy(turned, rotation, sizeof turned);
            turn(by, turned, 3);
            const double after = of_rotation(d, turned);
            if (after < cost) memcpy(rotation, turned, sizeof turned), cost = after, is_new = 1;
            if (dot(by, by) < 1e-18) return;
        }
        damping *= is_new ? 0.1 : 10;
        damping = damping < 1e-9 ? 1e-9 : damping > 1e3 ? 1e3 : damping;
    }
}

/* The two rotations that the homography between a plane and rays leaves; `_homography` and `_planar_starts` */
static void planar_starts(const Distances *d, double starts[2][9]) {
    double sight[3], frame[9], basis[6][9] = {{0}}, half[6][9], small[6][6], scale = 0;
    memcpy(sight, d->toward, sizeof sight);
    normalized(sight);
    frame_of(sight, frame);
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 3; k++) basis[i][3 * k + i % 2] = frame[3 * k + i / 2];
    for (int i = 0; i < 6; i++) mapped9(d, basis[i], half[i]);
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++) small[i][j] = product9(half[i], basis[j]);
    for (int i = 0; i < 6; i++) scale += small[i][i];
    const double a = small[4][4] + LEAST * scale + TINY, b = small[4][5], c = small[5][5] + LEAST * scale + TINY;
    const double determinant = a * c - b * b;
    double along[2][4], left[16], six[6], entries[9] = {0}, homography[9];
    for (int j = 0; j < 4; j++) {
        along[0][j] = (c * small[4][j] - b * small[5][j]) / determinant;
        along[1][j] = (a * small[5][j] - b * small[4][j]) / determinant;
    }
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < 4; j++) left[4 * i + j] = small[i][j] - small[i][4] * along[0][j] - small[i][5] * along[1][j];
    least_eigenvector(4, left, six);
    for (int k = 0; k < 2; k++) six[4 + k] = -(along[k][0] * six[0] + along[k][1] * six[1] + along[k][2] * six[2] + along[k][3] * six[3]);
    for (int i = 0; i < 6; i++)
        for (int k = 0; k < 9; k++) entries[k] += six[i] * basis[i][k];
    const double sign = product9(d->to_depth, entries) < 0 ? -1 : 1;
    for (int k = 0; k < 9; k++) homography[k] = sign * entries[k];
    for (int k = 0; k < 3; k++) homography[3 * k + 2] = sign * product9(d->to_translation[k], entries), sight[k] = homography[3 * k + 2];
    normalized(sight);
    frame_of(sight, frame);
    /* across the line of sight the columns of the rotation are known up to the distance, and the larger singular value of
       that part of a rotation is one */
    double p[4];
    for (int i = 0; i < 2; i++)
        for (int j = 0; j < 2; j++) p[2 * i + j] = frame[i] * homography[j] + frame[3 + i] * homography[3 + j] + frame[6 + i] * homography[6 + j];
    double largest = (hypot(p[0] + p[3], p[1] - p[2]) + hypot(p[0] - p[3], p[1] + p[2])) / 2;
    for (int k = 0; k < 4; k++) p[k] /= largest > TINY ? largest : TINY;
    const double x = 1 - p[0] * p[0] - p[2] * p[2], y = 1 - p[1] * p[1] - p[3] * p[3], rest = -p[0] * p[1] - p[2] * p[3];
    const double in_x = sqrt(x > 0 ? x : 0), in_y = sqrt(y > 0 ? y : 0) * (rest < 0 ? -1 : 1);
    for (int which = 0; which < 2; which++) {
        double first[3], second[3], third[3];
        for (int k = 0; k < 3; k++) {
            const double *f = frame + 3 * k, to = which ? -f[2] : f[2];
            first[k] = f[0] * p[0] + f[1] * p[2] + to * in_x, second[k] = f[0] * p[1] + f[1] * p[3] + to * in_y;
        }
        cross(first, second, third);
        for (int k = 0; k < 3; k++)
            starts[which][3 * k] = first[k], starts[which][3 * k + 1] = second[k], starts[which][3 * k + 2] = third[k];
    }
}

static int by_cost(const void *a, const void *b) {
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* Two rotations of points that are on no plane, whose main axes are the coordinates'; `_rotations_in_space` */
static void rotations_in_space(const Distances *d, const double *local, const double *rays, const double *weights,
                               int64_t count, double found[2][9]) {
    enum { ALL = TURNS + 4 };
    typedef struct { double cost, rotation[9]; } Start; /* the cost first: `by_cost` */
    Start starts[ALL];
    double sight[3], frame[9], form[81], v[9];
    memcpy(sight, d->toward, sizeof sight);
    normalized(sight);
    frame_of(sight, frame);
    memcpy(form, d->form, sizeof form);
    least_eigenvector(9, form, v);
    const double sign = product9(v, d->to_depth) < 0 ? -1 : 1;
    for (int k = 0; k < 9; k++) v[k] *= sign;
    nearest_rotation(v, starts[0].rotation);
    /* from afar, the two rows across the line of sight in units of the distance */
    double rows[3][3] = {{0}}, squares[3] = {0};
    for (int64_t i = 0; i < count; i++)
        for (int k = 0; k < 3 && weights[i] > 0; k++) {
            const double *r = rays + 3 * i, p = weights[i] * local[3 * i + k];
            for (int j = 0; j < 2; j++) rows[j][k] += p * (r[0] * frame[j] + r[1] * frame[3 + j] + r[2] * frame[6 + j]);
            squares[k] += p * local[3 * i + k];
        }
    for (int j = 0; j < 2; j++) {
        for (int k = 0; k < 3; k++) rows[j][k] /= squares[k] > TINY ? squares[k] : TINY;
        normalized(rows[j]);
    }
    cross(rows[0], rows[1], rows[2]);
    double afar[9], planar[2][9];
    multiplied(frame, rows[0], afar);
    nearest_rotation(afar, starts[1].rotation);
    planar_starts(d, planar);
    for (int which = 0; which < 2; which++) memcpy(starts[2 + which].rotation, planar[which], sizeof planar[0]);
    for (int number = 0, made = 4; number < 48; number++) { /* permutations and signs that are no mirrors */
        static const int orders[6][3] = {{0, 1, 2}, {1, 2, 0}, {2, 0, 1}, {0, 2, 1}, {2, 1, 0}, {1, 0, 2}};
        const int *order = orders[number / 8], signs = number % 8;
        if ((((signs & 1) + (signs >> 1 & 1) + (signs >> 2)) & 1) != (number >= 24)) continue;
        double axes[9] = {0};
        for (int k = 0; k < 3; k++) axes[3 * k + order[k]] = signs >> k & 1 ? -1 : 1;
        multiplied(frame, axes, starts[made++].rotation);
    }
    int begun = ALL;
    static const int go_on[3][2] = {{BEGUN, 2}, {FEW_BEGUN, STEPS}, {FEW_BEGUN, 0}};
    for (int turn_ = 0; turn_ < 3; turn_++) {
        for (int i = 0; i < begun; i++) {
            const double *rotation = starts[i].rotation, cost = of_rotation(d, rotation);
            starts[i].cost = product9(d->to_depth, rotation) > 0 && cost == cost ? cost : INFINITY;
        }
        qsort(starts, (size_t)begun, sizeof *starts, by_cost);
        begun = go_on[turn_][0];
        for (int i = 0; i < begun && go_on[turn_][1]; i++) descend(d, starts[i].rotation, go_on[turn_][1]);
    }
    memcpy(found[0], starts[0].rotation, sizeof found[0]);
    memcpy(found[1], starts[0].rotation, sizeof found[1]);
    for (int i = 1; i < begun; i++)
        if (!(trace_of_turn(starts[i].rotation, found[0]) > SAME_TRACE) && starts[i].cost < INFINITY) {
            memcpy(found[1], starts[i].rotation, sizeof found[1]);
            return;
        }
}

/* -- one row */

typedef struct {
    const double *points, *rays, *pixels, *weights; /* of what is given, or the following copies */
    int64_t count;
    double *own_points, *own_rays, *own_pixels, *own_weights, *local, *shares, *columns;
    uint8_t *inliers;
    Cameras camera;
    View view; /* as it was seen last */
    double middle[3], rounding; /* see `rounding_of` */
} Row;

/* The poses in which points lie on rays, the least angles first; `poses_from_rays` */
static void from_rays(const Row *row, double rotations[2][9], double translations[2][3], uint8_t *valid) {
    const int64_t n = row->count;
    double total = 0, centre[3] = {0}, products[9] = {0}, values[3], axes[9], *shares = row->shares, *local = row->local;
    int64_t seen = 0;
    for (int64_t i = 0; i < n; i++) {
        const double *p = row->points + 3 * i, *r = row->rays + 3 * i, w = row->weights[i];
        const int fine = w > 0 && isfinite(p[0] + p[1] + p[2] + r[0] + r[1] + r[2] + w);
        shares[i] = fine ? w : 0, total += shares[i], seen += fine;
    }
    for (int64_t i = 0; i < n; i++) {
        shares[i] /= total > TINY ? total : TINY;
        for (int k = 0; k < 3 && shares[i] > 0; k++) centre[k] += shares[i] * row->points[3 * i + k];
    }
    for (int64_t i = 0; i < n; i++) {
        double *p = local + 3 * i;
        for (int k = 0; k < 3; k++) p[k] = shares[i] > 0 ? row->points[3 * i + k] - centre[k] : 0;
        for (int k = 0; k < 9; k++) products[k] += shares[i] * p[k / 3] * p[k % 3];
    }
    eigen(3, products, values, axes);
    double extent[3], to_local[9];
    for (int k = 0; k < 3; k++) extent[k] = sqrt(values[k] > 0 ? values[k] : 0);
    const double size = extent[2] > TINY ? extent[2] : TINY;
    memcpy(to_local, axes + 6, 3 * sizeof *axes), memcpy(to_local + 3, axes + 3, 3 * sizeof *axes);
    cross(to_local, to_local + 3, to_local + 6);
    for (int64_t i = 0; i < n; i++) {
        double moved[3];
        applied(to_local, local + 3 * i, moved);
        for (int k = 0; k < 3; k++) local[3 * i + k] = moved[k] / size;
    }
    const int enough = seen >= 4 && extent[1] > FLAT * size, flat = extent[0] <= FLAT * size;
    Distances d;
    between(local, row->rays, shares, n, &d);
    if (flat) {
        planar_starts(&d, rotations);
        for (int which = 0; which < 2; which++) descend(&d, rotations[which], STEPS);
    } else rotations_in_space(&d, local, row->rays, shares, n, rotations);
    double scores[2];
    for (int which = 0; which < 2; which++) {
        double *rotation = rotations[which], *shift = translations[which], side = 0, score = 0, sum = 0;
        for (int k = 0; k < 3; k++) shift[k] = product9(d.to_translation[k], rotation);
        for (int64_t i = 0; i < n; i++) {
            double placed[3];
            applied(rotation, local + 3 * i, placed);
            for (int k = 0; k < 3; k++) placed[k] += shift[k];
            normalized(placed);
            const double cosine = shares[i] > 0 ? dot(placed, row->rays + 3 * i) : 0;
            side += shares[i] * ((cosine > 0) - (cosine < 0)), score += shares[i] * cosine, sum += shares[i];
        }
        /* a plane behind its rays is as near to them as the plane ahead that it is by a point reflection */
        if (flat && side < 0) {
            for (int k = 0; k < 9; k++) rotation[k] *= k % 3 == 2 ? 1 : -1;
            for (int k = 0; k < 3; k++) shift[k] = -shift[k];
            side = -side, score = -score;
        }
        scores[which] = sum - score == sum - score ? sum - score : INFINITY;
        multiplied(rotation, to_local, rotation);
        double turned[3];
        applied(rotation, centre, turned);
        double check = 0;
        for (int k = 0; k < 3; k++) shift[k] = shift[k] * size - turned[k], check += shift[k];
        for (int k = 0; k < 9; k++) check += rotation[k];
        valid[which] = enough && side > 0 && isfinite(check);
        if (!isfinite(check)) {
            for (int k = 0; k < 9; k++) rotation[k] = k % 4 == 0;
            memset(shift, 0, 3 * sizeof *shift);
        }
    }
    if (scores[1] < scores[0]) {
        double held[12];
        memcpy(held, rotations[0], 9 * sizeof *held), memcpy(held + 9, translations[0], 3 * sizeof *held);
        memcpy(rotations[0], rotations[1], 9 * sizeof *held), memcpy(translations[0], translations[1], 3 * sizeof *held);
        memcpy(rotations[1], held, 9 * sizeof *held), memcpy(translations[1], held + 9, 3 * sizeof *held);
        const uint8_t other = valid[0];
        valid[0] = valid[1], valid[1] = other;
    }
    valid[1] &= !(trace_of_turn(rotations[0], rotations[1]) > SAME_TRACE);
}

/* The cost of a pose, which `view` keeps; infinite where it is no number. Complete: whether all that counts has a pixel */
static double cost_of(const Poses *given, Row *row, const double *rotation, const double *translation, int *complete) {
    View *view = &row->view;
    view->camera = &row->camera, view->points = row->points, view->pixels = row->pixels, view->given = row->weights;
    view->rotation = rotation, view->shift = translation, view->loss = given->loss, view->loss_scale = given->loss_scale;
    const double cost = look(view);
    *complete = 1;
    for (int64_t i = 0; i < row->count; i++) *complete &= view->valid[i] || !(row->weights[i] > 0);
    return isfinite(cost) ? cost : INFINITY;
}

/* The triangle (6, 7) of derivatives by turn and shift, and of residuals, at the pose of the last `cost_of`; the sum of the
   squares of residuals */
static double linearised(Row *row, const double *translation, double found[6][7]) {
    const int64_t rows = 2 * row->count > 7 ? 2 * row->count : 7;
    double *columns = row->columns, *residuals = columns + 6 * rows;
    row->view.shift = translation;
    columns_of(&row->view, NULL, 0, columns, rows);
    const double square = product(residuals, residuals, rows);
    reduce(columns, 7, rows, 6);
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 7; j++) found[i][j] = j < i ? 0 : columns[j * rows + i];
    return square;
}

/* Goes from a pose to the minimum that it leads to, as `minimise` does; its cost. complete: whether all has a pixel there */
static double refine(const Poses *given, Row *row, double *rotation, double *translation, int64_t steps, uint8_t *converged,
                     int *complete) {
    static const double none[1] = {0};
    int seen = 0, tried;
    for (int64_t i = 0; i < row->count; i++) seen += row->weights[i] > 0;
    const double settled = given->settled / (2 * seen - 6 > 1 ? 2 * seen - 6 : 1), tiny = given->nothing * given->nothing * seen;
    double cost = cost_of(given, row, rotation, translation, complete), linear[6][7], memory[ONE_STEP];
    double damping = given->damping, growth = 4, decrement = 0;
    int is_new = 1, going = isfinite(cost) && cost > tiny;
    *converged = cost <= tiny;
    for (int64_t number = 0; going && number < steps; number++) {
        double by[6], turned[9], shifted[3];
        if (is_new) {
            linearised(row, translation, linear);
            decrement = 0;
            for (int a = 0; a < 6; a++) decrement += linear[a][6] * linear[a][6];
        }
        const double promised = decrement - step(linear[0], none, damping, 1, 6, 0, by, by, memory);
        memcpy(turned, rotation, sizeof turned);
        turn(by, turned, 3);
        for (int k = 0; k < 3; k++) shifted[k] = translation[k] + by[3 + k];
        const double after = cost_of(given, row, turned, shifted, &tried);
        const double rounding = 2 * sqrt(cost * row->rounding) + row->rounding;
        const double enough = settled * cost > rounding ? settled * cost : rounding;
        const int last = decrement <= enough;
        const double kept = (cost - after) / (promised > DBL_MIN ? promised : DBL_MIN);
        const int stuck = last || damping >= MOST_DAMPING;
        is_new = after < cost || (last && after <= cost + (rounding > 1e-12 * cost ? rounding : 1e-12 * cost));
        damping *= is_new ? kept > 0.75 ? 0.1 : kept > 0.25 ? 1 : 2 : growth;
        damping = damping < LEAST_DAMPING ? LEAST_DAMPING : damping > MOST_DAMPING ? MOST_DAMPING : damping;
        growth = is_new ? 4 : 2 * growth < 64 ? 2 * growth : 64;
        if (is_new) {
            cost = after, *complete = tried;
            memcpy(rotation, turned, sizeof turned), memcpy(translation, shifted, sizeof shifted);
        }
        *converged = last || cost <= tiny;
        going = !(*converged || (stuck && !is_new));
    }
    return cost;
}

/* The seen points about their middle, and their rays; what is unseen has weight 0. How many are seen */
static int64_t prepare(const Poses *given, Row *row) {
    const int64_t n = row->count;
    int64_t seen = 0;
    const Rows rows = {.cameras = &row->camera, .rows = row->pixels, .row_strides = {2 * n, 2, 1}, .results = row->own_rays,
                       .result_strides = {3 * n, 3, 1}, .valid = row->view.valid, .count = n, .tile = n, .direction = UNPROJECT};
    row->view.left += THIS(geometry)(&rows);
    double sum = 0, largest = 0;
    memset(row->middle, 0, sizeof row->middle);
    for (int64_t i = 0; i < n; i++) {
        const double *p = row->points + 3 * i, square = dot(p, p), w = given->weights ? row->weights[i] : 1;
        const int has = row->view.valid[i] && isfinite(square * square + w) && w > 0;
        row->own_weights[i] = has ? w : 0;
        for (int k = 0; k < 2; k++) {
            const double pixel = row->own_pixels[2 * i + k] = has ? row->pixels[2 * i + k] : 0;
            largest = fabs(pixel) > largest ? fabs(pixel) : largest;
        }
        for (int k = 0; k < 3; k++) row->middle[k] += has ? p[k] : 0;
        seen += has, sum += row->own_weights[i];
    }
    for (int k = 0; k < 3; k++) row->middle[k] /= seen > 1 ? (double)seen : 1;
    for (int64_t i = 0; i < 3 * n; i++) row->own_points[i] = row->own_weights[i / 3] > 0 ? row->points[i] - row->middle[i % 3] : 0;
    row->points = row->own_points, row->rays = row->own_rays, row->pixels = row->own_pixels, row->weights = row->own_weights;
    row->rounding = DBL_EPSILON * largest * DBL_EPSILON * largest * sum;
    return seen;
}

/* The moments (3, 3) of points that count, about their middle; how many they are */
static int64_t moments_of(const Row *row, double *moments, double *middle) {
    double sum = 0;
    int64_t seen = 0;
    memset(middle, 0, 3 * sizeof *middle), memset(moments, 0, 9 * sizeof *moments);
    for (int64_t i = 0; i < row->count; i++) {
        for (int k = 0; k < 3; k++) middle[k] += row->weights[i] * row->points[3 * i + k];
        sum += row->weights[i], seen += row->weights[i] > 0;
    }
    for (int k = 0; k < 3; k++) middle[k] /= sum > TINY ? sum : TINY;
    for (int64_t i = 0; i < row->count; i++)
        for (int k = 0; k < 9; k++)
            moments[k] += row->weights[i] * (row->points[3 * i + k / 3] - middle[k / 3]) * (row->points[3 * i + k % 3] - middle[k % 3]);
    return seen;
}

/* The pose whose normal of the plane that points nearly lie on is mirrored at the line of sight, if they do */
static int mirrored(const Row *row, const double *rotation, const double *translation, double *other, double *shift) {
    double moments[9], centre[3], values[3], axes[9], middle[3], sight[3], across[9], in_plane[9], turned[3];
    moments_of(row, moments, centre);
    eigen(3, moments, values, axes);
    if (!(values[0] <= THIN * THIN * values[2])) return 0;
    applied(rotation, centre, middle);
    for (int k = 0; k < 3; k++) sight[k] = middle[k] += translation[k];
    normalized(sight);
    for (int k = 0; k < 9; k++) {
        across[k] = (k % 4 == 0) - 2 * sight[k / 3] * sight[k % 3];
        in_plane[k] = (k % 4 == 0) - 2 * axes[k / 3] * axes[k % 3];
    }
    multiplied(across, rotation, other);
    multiplied(other, in_plane, other);
    applied(other, centre, turned);
    for (int k = 0; k < 3; k++) shift[k] = middle[k] - turned[k];
    return 1;
}

/* Takes the minimum that a pose leads to if it is lower; its cost. What is far from that after some steps goes no further */
static double or_better(const Poses *given, Row *row, double *rotation, double *translation, double cost,
                        const double *other, const double *shift) {
    const int64_t first = isfinite(cost) && given->steps > FEW_STEPS ? FEW_STEPS : given->steps;
    double turned[9], shifted[3];
    uint8_t converged;
    int complete;
    memcpy(turned, other, sizeof turned), memcpy(shifted, shift, sizeof shifted);
    double found = refine(given, row, turned, shifted, first, &converged, &complete);
    if (!converged && found <= WORSE * cost) found = refine(given, row, turned, shifted, given->steps - first, &converged, &complete);
    if (!(converged && complete && found < cost)) return cost;
    memcpy(rotation, turned, sizeof turned), memcpy(translation, shifted, sizeof shifted);
    return found;
}

/* Takes the lowest minimum that poses of three of four points lead to, if it is lower; its cost */
static double by_three(const Poses *given, Row *row, double *rotation, double *translation, double cost) {
    double points[3][3], rays[3][3], poses[4][12], turned[9], shifted[3];
    int64_t places[4];
    int complete;
    for (int64_t i = 0, seen = 0; i < row->count; i++)
        if (row->weights[i] > 0) places[seen++] = 3 * i;
    cost *= 1 - 1e-6; /* a smaller difference is rounding */
    for (int without = 0; without < 4; without++) {
        for (int k = 0; k < 3; k++) {
            const int64_t place = places[k + (k >= without)];
            memcpy(points[k], row->points + place, sizeof *points), memcpy(rays[k], row->rays + place, sizeof *rays);
        }
        for (int left = THIS(poses_of_three)(points, rays, poses); left-- > 0;) {
            for (int k = 0; k < 3; k++) {
                memcpy(turned + 3 * k, poses[left] + 4 * k, 3 * sizeof *turned);
                shifted[k] = poses[left][4 * k + 3];
            }
            if (trace_of_turn(turned, rotation) > SAME_TRACE) continue;
            if (cost_of(given, row, turned, shifted, &complete) <= WORSE * cost)
                cost = or_better(given, row, rotation, translation, cost, turned, shifted);
        }
    }
    return cost;
}

/* The pose of least cost of all that is seen; its cost */
static double solve(const Poses *given, Row *row, double *rotation, double *translation) {
    double rotations[2][9], translations[2][3], costs[2], mirror[9], shift[3];
    uint8_t valid[2];
    int complete;
    const int64_t seen = prepare(given, row);
    const int few = seen <= FEW;
    from_rays(row, rotations, translations, valid);
    for (int i = 0; i < 2; i++) costs[i] = valid[i] ? cost_of(given, row, rotations[i], translations[i], &complete) : INFINITY;
    const int best = costs[1] < costs[0];
    memcpy(rotation, rotations[best], sizeof *rotations), memcpy(translation, translations[best], sizeof *translations);
    if (!valid[best]) return INFINITY;
    double cost = or_better(given, row, rotation, translation, INFINITY, rotation, translation);
    if (valid[!best] && (few || !isfinite(cost) || costs[!best] <= WORSE * costs[best]))
        cost = or_better(given, row, rotation, translation, cost, rotations[!best], translations[!best]);
    /* of points on a plane the other minimum may be one of pixels, and none of rays: of few, and of much noise */
    if (isfinite(cost) && mirrored(row, rotation, translation, mirror, shift) &&
        ((few && !valid[!best]) || cost_of(given, row, mirror, shift, &complete) <= WORSE * cost))
        cost = or_better(given, row, rotation, translation, cost, mirror, shift);
    return seen == 4 && cost > 4 * given->nothing * given->nothing ? by_three(given, row, rotation, translation, cost) : cost;
}

/* The pose of least cost of the points on which most agree, from one that is near: in turns, which points these are, and a
   minimum. Infinite if there is no end to it, or if too few agree, or points on a line */
static double agree(const Poses *given, Row *row, double *rotation, double *translation) {
    const double most = given->threshold * given->threshold;
    double moments[9], middle[3];
    uint8_t converged = 0;
    int complete = 0, same = 0;
    prepare(given, row);
    memcpy(row->shares, row->own_weights, (size_t)row->count * sizeof(double));
    double cost = INFINITY;
    for (int round = 0; round < ROUNDS && !same; round++) {
        memcpy(row->own_weights, row->shares, (size_t)row->count * sizeof(double));
        cost_of(given, row, rotation, translation, &complete);
        same = round > 0;
        for (int64_t i = 0; i < row->count; i++) {
            const double *away = row->view.residuals + 2 * i;
            const int near = row->view.valid[i] && away[0] * away[0] + away[1] * away[1] < most && row->shares[i] > 0;
            same &= near == row->inliers[i], row->inliers[i] = (uint8_t)near;
            row->own_weights[i] = near ? row->shares[i] : 0;
        }
        if (!same) cost = refine(given, row, rotation, translation, given->steps, &converged, &complete);
    }
    const int64_t seen = moments_of(row, moments, middle);
    const double trace = moments[0] + moments[4] + moments[8];
    double squares = 0;
    for (int k = 0; k < 9; k++) squares += moments[k] * moments[k];
    const int enough = seen >= 4 && trace * trace - squares > 2 * LINE * LINE * trace * trace;
    return converged && complete && enough ? cost : INFINITY;
}

/* What a pose is worth: the vector of its rotation, the root mean square, and the covariance of turn and shift of the origin,
   from which the points' middle lies in the camera's axes */
static void assess(const Poses *given, Row *row, int64_t at, double cost) {
    double *rotation = given->rotations + 9 * at, *translation = given->translations + 3 * at, *covariance = given->covariance + 36 * at;
    double linear[6][7], scale[6], inverse[6][6], carried[6][6] = {{0}}, away[3], sum = 0;
    int complete, inliers = 0, fine = isfinite(cost);
    const int is_valid = fine;
    cost_of(given, row, rotation, translation, &complete);
    const double residual = linearised(row, translation, linear);
    for (int64_t i = 0; i < row->count; i++) {
        const int has = row->weights[i] > 0;
        given->inliers[at * row->count + i] = (uint8_t)(is_valid && has), inliers += has, sum += row->weights[i];
    }
    const double variance = residual / (2 * inliers - 6 > 1 ? 2 * inliers - 6 : 1);
    for (int b = 0; b < 6; b++) {
        double square = 0;
        for (int a = 0; a <= b; a++) square += linear[a][b] * linear[a][b];
        scale[b] = square > 0 ? 1 / sqrt(square) : 1;
        for (int a = 0; a <= b; a++) linear[a][b] *= scale[b];
        fine &= linear[b][b] != 0;
    }
    applied(rotation, row->middle, away);
    for (int a = 0; a < 6; a++) {
        double unit[6] = {0};
        unit[a] = 1;
        if (fine) solved(6, 7, linear[0], unit);
        for (int b = 0; b < 6; b++) inverse[b][a] = fine ? unit[b] * scale[a] * scale[b] * variance : NAN;
        carried[a][a] = 1;
    }
    for (int k = 0; k < 3; k++) translation[k] -= away[k];
    carried[3][1] = -away[2], carried[3][2] = away[1], carried[4][0] = away[2];
    carried[4][2] = -away[0], carried[5][0] = -away[1], carried[5][1] = away[0];
    for (int k = 0; k < 36; k++) {
        covariance[k] = 0;
        for (int a = 0; a < 36; a++) covariance[k] += carried[k / 6][a / 6] * inverse[a / 6][a % 6] * carried[k % 6][a % 6];
    }
    vector_of(rotation, given->vectors + 3 * at);
    given->rms[at] = is_valid ? sqrt(residual / (sum > DBL_MIN ? sum : DBL_MIN)) : INFINITY, given->valid[at] = (uint8_t)is_valid;
}

/* Takes rows, of those that no thread has taken, until none is left */
void THIS(poses)(const Poses *given) {
    const int64_t n = given->count;
    const int64_t rows = 2 * n > 7 ? 2 * n : 7;
    Row row = {.count = n, .view.count = n};
    double *memory = malloc((size_t)(22 * n + 7 * rows) * sizeof *memory + (size_t)n * 2);
    if (!memory) {
        __atomic_store_n(given->left, -1, __ATOMIC_RELAXED);
        return;
    }
    row.own_points = memory, row.own_rays = memory + 3 * n, row.own_pixels = memory + 6 * n, row.own_weights = memory + 8 * n;
    row.local = memory + 9 * n, row.shares = memory + 12 * n, row.columns = memory + 22 * n;
    row.view.residuals = memory + 13 * n, row.view.weights = memory + 15 * n, row.view.moved = memory + 16 * n;
    row.view.slopes = memory + 19 * n, row.view.valid = (uint8_t *)(row.columns + 7 * rows), row.inliers = row.view.valid + n;
    for (int64_t at; (at = __atomic_fetch_add(given->next, 1, __ATOMIC_RELAXED)) < given->row_count;) {
        double *rotation = given->rotations + 9 * at, *translation = given->translations + 3 * at, cost;
        row.points = given->points + at % given->point_rows * 3 * n, row.rays = given->rays + at * 3 * n;
        row.pixels = given->pixels + at * 2 * n, row.weights = given->weights + at * n, row.view.left = 0;
        if (given->task == FROM_RAYS) {
            from_rays(&row, (double(*)[9])(given->rotations + 18 * at), (double(*)[3])(given->translations + 6 * at), given->valid + 2 * at);
            continue;
        }
        row.camera = only(given->cameras, at);
        if (given->task == REFINED) {
            double largest = 0, sum = 0;
            int complete;
            for (int64_t i = 0; i < n; i++) {
                const double u = fabs(row.pixels[2 * i]), v = fabs(row.pixels[2 * i + 1]), size = u > v ? u : v;
                sum += row.weights[i], largest = row.weights[i] > 0 && size > largest ? size : largest;
            }
            row.rounding = DBL_EPSILON * largest * DBL_EPSILON * largest * sum;
            given->costs[at] = refine(given, &row, rotation, translation, given->steps, given->valid + at, &complete);
        } else {
            cost = given->task == SOLVED ? solve(given, &row, rotation, translation) : agree(given, &row, rotation, translation);
            assess(given, &row, at, cost);
        }
        __atomic_fetch_add(given->left, row.view.left, __ATOMIC_RELAXED);
    }
    free(memory);
}
