/* Where a lens is one-to-one, and the table that its inverse starts from, in double precision: projection/domain.py,
 * optics/radial_inverse.py, which say why.
 */

enum { STEPS = 129 };         /* radii on which the image of a radial stage is looked at */
#define LEAST_SLOPE 0.75
#define WIDER 1.25
#define TAN_87 19.081136687728211 /* of 87 degrees */

/* The lens of a camera */
typedef struct {
    const Domain *of;
    const Part *part;   /* the first stage */
    const double *numbers; /* of the first stage */
    const double *constants;
} Lens;

static void factors(const Lens *lens, int n, const double *t, double *factor, double *slope) {
    const Factor_double of = prepare_factor_double(lens->part, lens->numbers, lens->constants);
    for (int i = 0; i < n; i += BLOCK) {
        const int here = n - i < BLOCK ? n - i : BLOCK;
        ALIGNED double square[BLOCK] = {0}, value[BLOCK], by_t[BLOCK];
        memcpy(square, t + i, (size_t)here * sizeof(double));
        radial_double(&of, (here + LANES - 1) & -LANES, square, value, slope ? by_t : NULL);
        memcpy(factor + i, value, (size_t)here * sizeof(double));
        if (slope) memcpy(slope + i, by_t, (size_t)here * sizeof(double));
    }
}

/* -- the fold */

static double polynomial_at(int degree, const double *c, double t, double *slope) {
    double value = c[degree], by_t = 0;
    for (int j = degree - 1; j >= 0; j--) by_t = by_t * t + value, value = value * t + c[j];
    *slope = by_t;
    return value;
}

/* The root between two places at which the sign differs: Newton's method, and halves of the bracket where that leaves it
   or does not halve its step */
static double root_between(int degree, const double *c, double low, double high) {
    double slope, t = low + (high - low) / 2, last = high - low;
    const int below = polynomial_at(degree, c, low, &slope) < 0;
    for (int count = 0; count < 400; count++) {
        const double value = polynomial_at(degree, c, t, &slope), step = value / slope, ahead = t - step;
        if (value == 0 || fabs(step) <= 2 * DBL_EPSILON * fabs(t)) return ahead >= low && ahead <= high ? ahead : t;
        if ((value < 0) == below) low = t;
        else high = t;
        if (ahead > low && ahead < high && 2 * fabs(step) < last) last = fabs(step), t = ahead;
        else {
            /* of ends far apart the mean of their exponents */
            const double middle = low > 0 && high > 4 * low ? sqrt(low) * sqrt(high)
                                  : low > 0                 ? low + (high - low) / 2
                                                            : high / 1024;
            if (middle <= low || middle >= high) return middle;
            last = high - low, t = middle;
        }
    }
    return t;
}

/* The roots up to `end`, ascending, at which a polynomial changes its sign, and their number: between those of its
   derivative it is monotone */
static int roots_up_to(int degree, const double *c, double end, double *roots) {
    double slope[MOST_DEGREE + 1], turns[MOST_DEGREE + 2];
    int count = 0, found = 0;
    while (degree > 0 && c[degree] == 0) degree--;
    if (degree < 1) return 0;
    for (int j = 1; j <= degree; j++) slope[j - 1] = j * c[j];
    turns[count++] = 0;
    count += roots_up_to(degree - 1, slope, end, turns + count);
    turns[count++] = end;
    double unused, before = polynomial_at(degree, c, 0, &unused);
    for (int i = 1; i < count; i++) {
        const double here = polynomial_at(degree, c, turns[i], &unused);
        if ((before < 0) != (here < 0)) roots[found++] = root_between(degree, c, turns[i - 1], turns[i]);
        before = here;
    }
    return found;
}

/* The smallest t up to `end` at which 1 + c1 t + ... turns negative, infinite where there is none */
static double first_root(int degree, const double *c, double end) {
    double roots[MOST_DEGREE];
    return roots_up_to(degree, c, end, roots) ? roots[0] : INFINITY;
}

/* The radius at which the factor of a stage is lost, up to `end` */
static double closed_fold(const Part *part, const double *k, double end) {
    double c[MOST_DEGREE + 1] = {1};
    const int n = part->n;
    if (n + part->m > MOST_DEGREE || part->factor == RADIUS_TABLE) return end; /* the caller finds those in `folds` */
    switch (part->factor) {
    case POLYNOMIAL:
    case RADIUS_POLYNOMIAL:
    case ANGLE_PER_RADIUS:
    case ANGLE_OF_ALL_POWERS: {
        const int all = part->factor == RADIUS_POLYNOMIAL || part->factor == ANGLE_OF_ALL_POWERS;
        for (int i = 0; i < n; i++)
            c[i + 1] = k[i] * (part->factor == POLYNOMIAL          ? 2 * i + 3
                               : part->factor == RADIUS_POLYNOMIAL ? i + 2
                               : part->factor == ANGLE_PER_RADIUS  ? -(2 * i + 1)
                                                                   : -i);
        return all ? first_root(n, c, end) : sqrt(first_root(n, c, end * end));
    }
    default: { /* RATIONAL: of N D + 2 t (N' D - N D'), or of D */
        const int m = part->m;
        memset(c, 0, sizeof c);
        for (int i = 0; i <= n; i++)
            for (int j = 0; j <= m; j++)
                c[i + j] += (1 + 2 * (i - j)) * (i ? k[i - 1] : 1) * (j ? k[n + j - 1] : 1);
        const double turned = first_root(n + m, c, end * end);
        c[0] = 1;
        memcpy(c + 1, k + n, (size_t)m * sizeof(double));
        const double pole = first_root(m, c, end * end);
        return sqrt(turned < pole ? turned : pole);
    }
    }
}

static int is_number(const Lens *lens, double radius, double most) {
    double factor, t = radius * radius;
    factors(lens, 1, &t, &factor, NULL);
    return radius * factor <= most;
}

/* The same, before the image leaves the numbers to calculate with */
static double fold_of(const Lens *lens, double given, double end, double most) {
    double high = given == given ? given : closed_fold(lens->part, lens->numbers, end);
    high = high < end ? high : end;
    if (lens->part->factor == RADIUS_TABLE || is_number(lens, high, most)) return high;
    double low = high < 1e12 ? high : 1e12;
    do low = low > 2 ? sqrt(low) : low / 2;
    while (low > 0 && !is_number(lens, low, most));
    for (int count = 0; count < 64; count++) {
        const double middle = sqrt(low) * sqrt(high);
        if (is_number(lens, middle, most)) low = middle;
        else high = middle;
    }
    return low;
}

/* -- the table of the inverse of a radial factor */

static double square_at(double u, double top2) {
    const double x = u * (2 - u) * (top2 / (top2 + 2));
    return 2 * x / (1 - x);
}

static double variable_of(double r2, double top2) {
    const double left = 1 - r2 / (r2 + 2) * ((top2 + 2) / top2);
    return 1 - sqrt(left > 0 ? left : 0);
}

/* (2 + 2 NODES): `radial_inverse.tabulate` */
static void tabulate(const Lens *lens, double fold, double usual_end, double *table) {
    double t[NODES + 1], factor[NODES + 1], slope[NODES + 1], at[NODES + 1], scale[NODES + 1], wanted[NODES + 1];
    double value[NODES + 1], most[NODES + 1];
    const double end = fold < usual_end ? fold : usual_end;
    for (int i = 0; i <= NODES; i++) t[i] = square_at((double)i / NODES, end * end);
    factors(lens, NODES + 1, t, factor, NULL);
    double furthest = 0;
    for (int i = 0; i <= NODES; i++) {
        const double r2 = t[i] * factor[i] * factor[i];
        at[i] = furthest = i && !(r2 > furthest) ? furthest : r2;
        scale[i] = 1 / factor[i];
    }
    for (int i = 0; i <= NODES; i++) at[i] = variable_of(at[i], furthest), wanted[i] = square_at((double)i / NODES, furthest);
    for (int i = 0, cell = 0; i <= NODES; i++) {
        const double u = (double)i / NODES;
        while (cell < NODES - 1 && at[cell + 1] <= u) cell++;
        const double low = at[cell], high = at[cell + 1], step = scale[cell + 1] - scale[cell];
        double share = (u - low) / (high > low ? high - low : 1);
        share = share > 0 ? share < 1 ? share : 1 : 0;
        value[i] = scale[cell] + share * step, most[i] = fabs(step);
    }
    for (int count = 0; count < 2; count++) {
        for (int i = 0; i <= NODES; i++) t[i] = wanted[i] * value[i] * value[i];
        factors(lens, NODES + 1, t, factor, slope);
        for (int i = 0; i <= NODES; i++) {
            const double ascent = factor[i] + 2 * t[i] * slope[i];
            double off = (value[i] * factor[i] - 1) / (ascent > 0 ? ascent : 1);
            off = off < most[i] ? off : most[i];
            value[i] -= off > -most[i] ? off : -most[i];
        }
    }
    value[NODES] = scale[NODES];
    table[0] = furthest, table[1] = fold > usual_end ? INFINITY : furthest;
    for (int i = 0; i < NODES; i++) table[2 + i] = value[i], table[2 + NODES + i] = value[i + 1] - value[i];
}

/* -- bounds of stages, on circles of ascending radii: `Stage.lower_bound` */

static void bound_planar(const Lens *lens, int n, double *radius, double *least) {
    double t[MOST_RADII], factor[MOST_RADII], slope[MOST_RADII];
    const Part *part = lens->part;
    const double *rest = lens->numbers + (part->factor == RADIUS_TABLE ? 4 * part->n : part->n + part->m);
    const int bent = part->flags & TANGENTIAL;
    const double p = bent ? hypot(rest[0], rest[1]) : 0, *s = part->flags & PRISM ? rest + 2 * !!bent : NULL;
    for (int i = 0; i < n; i++) t[i] = radius[i] * radius[i];
    if (part->factor == NO_FACTOR)
        for (int i = 0; i < n; i++) factor[i] = 1, slope[i] = 0;
    else factors(lens, n, t, factor, slope);
    for (int i = 0; i < n; i++) {
        const double rho = radius[i], ascent = factor[i] + 2 * t[i] * slope[i];
        double low = ascent < factor[i] ? ascent : factor[i];
        low = ascent == ascent ? low : NAN;
        if (part->factor == RATIONAL) {
            double unused, c[MOST_DEGREE + 1] = {1};
            memcpy(c + 1, lens->numbers + part->n, (size_t)part->m * sizeof(double));
            const double margin = polynomial_at(part->m, c, t[i], &unused);
            low = margin < low ? margin : low;
        }
        double out = rho * fabs(factor[i]);
        low -= 6 * p * rho, out += 3 * p * t[i];
        if (s) {
            low -= 2 * rho * hypot(s[0] + 2 * t[i] * s[1], s[2] + 2 * t[i] * s[3]);
            out += t[i] * hypot(s[0] + t[i] * s[1], s[2] + t[i] * s[3]);
        }
        least[i] = low, radius[i] = out;
    }
}

static void bound_homography(const double *k, int n, double *radius, double *least) {
    const double slope = hypot(k[6], k[7]), across = hypot(k[0], k[3]), along = hypot(k[1], k[4]);
    const double size = (across > along ? across : along) * sqrt(2), shift = hypot(k[2], k[5]);
    double m[9];
    adjugate_double(k, m);
    const double area = k[6] * m[2] + k[7] * m[5] + k[8] * m[8];
    for (int i = 0; i < n; i++) {
        const double nearest = k[8] - slope * radius[i], lowest = nearest < area ? nearest : area;
        /* past the horizon nothing is certain */
        const double seen = (size * radius[i] + shift) / (nearest > 0 ? nearest : NAN);
        const double turned = k[0] + k[4] - slope * seen;
        least[i] = turned == turned ? lowest < turned ? lowest : turned : NAN;
        radius[i] = seen;
    }
}

/* The largest of what begins within each radius, none less than 0: `here` becomes that up to each */
static void reach(int n, const double *radius, double begin, double value, double *here) {
    int low = 0, high = n;
    while (low < high) {
        const int middle = (low + high) / 2;
        if (radius[middle] < begin) low = middle + 1;
        else high = middle;
    }
    if (low < n && value > here[low]) here[low] = value;
}

/* Slopes of a spline lie between those of the lines from control point to control point */
static void bound_surface(const Part *part, const double *k, int n, double *radius, double *least) {
    double steepest[MOST_RADII] = {0}, over[MOST_RADII] = {0}, down[MOST_RADII] = {0}, far[MOST_RADII] = {0};
    const double *s = part->cells;
    double begin[2];
    const int size[2] = {part->n, part->m};
    for (int j = 0; j < size[1]; j++)
        for (int i = 0; i < size[0]; i++) {
            const double *at = k + 2 * (j * size[0] + i);
            for (int more = 0; more < 3; more++) { /* the point, and the lines along a and along b */
                if ((more == 1 && i + 1 == size[0]) || (more == 2 && j + 1 == size[1])) continue;
                for (int axis = 0; axis < 2; axis++) {
                    const double line = more == axis + 1, place = (axis ? j : i) - (size[axis] - 1 - line) / 2;
                    const double away = fabs(place / s[axis] + part->centre[axis]) - ((part->flags + 1 - line) / 2) / s[axis];
                    begin[axis] = away > 0 ? away : 0;
                }
                const double out = hypot(begin[0], begin[1]);
                const double *next = at + (more == 2 ? 2 * size[0] : 2), scale = more ? s[more - 1] : 1;
                if (!more) reach(n, radius, out, hypot(at[0], at[1]), far);
                else {
                    const double by_x = (next[0] - at[0]) * scale, by_y = (next[1] - at[1]) * scale;
                    reach(n, radius, out, more == 1 ? -by_x : -by_y, steepest);
                    reach(n, radius, out, fabs(more == 1 ? by_y : by_x), more == 1 ? over : down);
                }
            }
        }
    const double end_a = (size[0] - part->flags) / 2.0 / s[0] - fabs(part->centre[0]);
    const double end_b = (size[1] - part->flags) / 2.0 / s[1] - fabs(part->centre[1]), end = end_a < end_b ? end_a : end_b;
    for (int i = 0; i < n; i++) {
        double *const all[4] = {steepest, over, down, far};
        for (int j = 0; i && j < 4; j++) all[j][i] = all[j][i - 1] > all[j][i] ? all[j][i - 1] : all[j][i];
        const double inside = end - radius[i], slope = 1 - steepest[i] - (over[i] + down[i]) / 2;
        least[i] = inside > 0 ? slope : inside > -1e-3 ? -1e-3 : inside;
        radius[i] += far[i];
    }
}

/* The smallest bound of the stages from `first` on; radii become how far out their points go */
static void bound_lens(const Lens *lens, int first, int n, double *radius, double *least) {
    double here[MOST_RADII];
    Lens stage = *lens;
    for (int j = 1; j < lens->of->part_count; j++) {
        stage.part = lens->of->parts + j;
        if (j >= first) {
            if (stage.part->kind == HOMOGRAPHY) bound_homography(stage.numbers, n, radius, here);
            else if (stage.part->kind == SHEAR) {
                const double d = stage.numbers[0], e = stage.numbers[1];
                const double wider = 1 + (fabs(d) > fabs(e) ? fabs(d) : fabs(e));
                for (int i = 0; i < n; i++) here[i] = 1 - fabs(d + e) / 2, radius[i] *= wider;
            } else if (stage.part->kind == SURFACE) bound_surface(stage.part, stage.numbers, n, radius, here);
            else bound_planar(&stage, n, radius, here);
            /* the next stage sees what any smaller circle becomes as well; what is not a number stays none */
            for (int i = 1; i < n; i++) radius[i] = radius[i - 1] > radius[i] || radius[i - 1] != radius[i - 1] ? radius[i - 1] : radius[i];
            for (int i = 0; i < n; i++) least[i] = j == first || here[i] < least[i] || here[i] != here[i] ? here[i] : least[i];
        }
        stage.numbers += numbers_of(stage.part);
    }
}

/* The node, with a fraction at a dip, where an orientation is first lost; n where it never is. No dip is assumed next to
   nodes that are `spared` */
static double first_loss(int n, const double *orientation, const uint8_t *spared) {
    double first = n;
    for (int i = 0; i < n; i++) {
        double lost = orientation[i] > 0 ? INFINITY : i;
        if (i > 0 && i < n - 1) {
            const double bend = orientation[i - 1] - 2 * orientation[i] + orientation[i + 1];
            const double tilt = orientation[i - 1] - orientation[i + 1];
            const int dips = bend > 0 && fabs(tilt) <= bend && orientation[i] - tilt * tilt / (8 * bend) <= 0;
            if (dips && !(spared && spared[i])) lost = i + (orientation[i] > 0 ? tilt / (2 * bend) : 0);
        }
        first = lost < first ? lost : first;
    }
    return first;
}

/* -- cameras */

/* The squared radius of a circle of the image beyond which there is nothing, infinite where that is not known */
static double image_circle_sq_of(const Lens *lens, double edge) {
    double radius[STEPS], least[STEPS], change = 0, certain = INFINITY, furthest = 0;
    for (int i = 0; i < STEPS; i++) radius[i] = edge * (WIDER * i / (STEPS - 1));
    bound_lens(lens, 2, STEPS, radius, least);
    for (int i = 0; i < STEPS; i++) {
        if (least[i] != least[i]) return INFINITY;
        certain = least[i] < certain ? least[i] : certain;
        if (i && fabs(least[i] - least[i - 1]) > change) change = fabs(least[i] - least[i - 1]);
        if (WIDER * i <= STEPS - 1 + WIDER && radius[i] > furthest) furthest = radius[i];
    }
    return certain - change > LEAST_SLOPE ? furthest * furthest : INFINITY;
}

/* The radius at which a unified chart ends, and beyond which there are no images: `Unified.end`, `usual_end` */
static void ends_of_unified(const Part *chart, const double *k, int is_double, double *end, double *usual_end) {
    const double xi = chart->flags & HAS_XI ? *k++ : 0, alpha = chart->flags & HAS_ALPHA ? *k++ : chart->constant;
    const double fold = (2 * alpha - 1) * (chart->flags & HAS_BETA ? *k : 1), beyond = (xi - 1) * (xi + 1);
    const double inside = 1 - 64 * (is_double ? DBL_EPSILON : FLT_EPSILON);
    const double usual = TAN_87 / (chart->flags & HAS_XI || chart->constant == 0 ? 1 : chart->constant);
    *end = (is_double ? 1e9 : 19112.41165783858) / 2;
    if (fold > 0) *end = fmin(*end, inside / sqrt(fold));
    if (beyond > 0) *end = fmin(*end, inside / (alpha * xi + (1 - alpha) * sqrt(beyond)));
    *usual_end = fmin(*end, usual);
}

/* The squared radius up to which a lens that folds there is certainly regular, in the precision of the points */
static double within(double fold, double end, int is_double) {
    if (is_double) {
        const double inner = (fold < end ? fold : end) * (1 - 4 * DBL_EPSILON);
        return inner * inner;
    }
    const float here = (float)fold, last = (float)end, inner = (here < last ? here : last) * (1 - 4 * FLT_EPSILON);
    return inner * inner;
}

static void put(void *to, int64_t at, double value, int is_double) {
    if (is_double) ((double *)to)[at] = value;
    else ((float *)to)[at] = (float)value;
}

#include "geometry_azimuths.h"

/* Fills in what of a `Domain` is wanted */
void THIS(domain)(const Domain *d) {
    const int is_double = (int)d->is_double;
    const Part *first = d->parts + 1; /* after the chart; of an inverted chart its factor takes its place */
    for (int64_t c = 0; c < d->cameras; c++) {
        const double *numbers = d->parameters + c * d->parameter_count;
        double end, usual_end;
        if (d->ends) end = d->ends[c], usual_end = d->usual_ends[c];
        else ends_of_unified(d->parts, numbers, is_double, &end, &usual_end);
        Lens lens = {d, first, numbers + numbers_of(d->parts), d->constants + c * d->constant_count};
        Part factor;
        if (d->is_chart) {
            factor = d->parts[0], factor.kind = PLANAR, factor.flags = 0;
            lens.part = &factor, lens.numbers = numbers;
        }
        double fold = 0, table[2 + 2 * NODES];
        const int has_factor = lens.part->factor != NO_FACTOR;
        int goes_by_stages = 0;
        if (has_factor && (d->safe_radius_sq || d->limits2 || d->table)) fold = fold_of(&lens, d->folds ? d->folds[c] : NAN, end, d->most);
        if (d->image_circle_sq) {
            double value, square = fold * fold;
            factors(&lens, 1, &square, &value, NULL);
            const double image_circle_sq = image_circle_sq_of(&lens, fold * value);
            goes_by_stages = image_circle_sq < INFINITY;
            d->stagewise[c] = (uint8_t)goes_by_stages;
            put(d->image_circle_sq, c, image_circle_sq, is_double);
        }
        if (d->safe_radius_sq) {
            double inner = fold;
            if (!d->is_chart && !d->is_radial && !goes_by_stages) {
                double radius[MOST_RADII], least[MOST_RADII];
                memcpy(radius, d->radii, sizeof radius);
                bound_lens(&lens, 1, MOST_RADII, radius, least);
                double node = floor(first_loss(MOST_RADII, least, NULL) - 1);
                node = node > 0 ? node < MOST_RADII - 1 ? node : MOST_RADII - 1 : 0;
                inner = d->radii[(int)node];
            }
            const double safe_radius_sq = within(inner, end, is_double), image_radius_sq = usual_end * usual_end;
            put(d->safe_radius_sq, c, safe_radius_sq, is_double);
            if (d->image_radius_sq) put(d->image_radius_sq, c, safe_radius_sq < image_radius_sq ? safe_radius_sq : image_radius_sq, is_double);
        }
        if (d->limits2 && goes_by_stages) follow_nothing(d, c);
        else if (d->limits2) {
            Camera_double camera;
            lens_of(d, c, &camera);
            follow(d, c, &camera, has_factor ? fold : NAN, end);
        }
        if (d->table && has_factor) {
            tabulate(&lens, fold, usual_end, table);
            for (int i = 0; i < 2 + 2 * NODES; i++) put(d->table, c * (2 + 2 * NODES) + i, table[i], is_double);
        }
    }
}
