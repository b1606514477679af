/* A lens followed outwards on azimuths, in double precision: how far out it stays one-to-one, and where to start its
 * inverse; projection/fold.py, which says why.
 */

/* Of radii at fractional places; infinite from RADII on */
static double radius_at(const double *radii, double place) {
    const int index = place < RADII - 1 ? (int)place : RADII - 1, next = index < RADII - 1 ? index + 1 : index;
    return place <= RADII - 1 ? radii[index] + (place - index) * (radii[next] - radii[index]) : INFINITY;
}

/* `first_loss`, where dips between coarse nodes count only if a closer look finds them */
static double loss_on(const Camera_double *c, double a, double b, const double *radii, const double *orientation) {
    ALIGNED double x[BLOCK], y[BLOCK], u[BLOCK], v[BLOCK], least[BLOCK];
    Jacobian_double to;
    uint8_t spared[RADII] = {0};
    for (int count = 0;; count++) {
        const double lost = first_loss(RADII, orientation, spared);
        const int node = lost < RADII - 1 ? (int)nearbyint(lost) : RADII - 1;
        if (count == RADII || lost > RADII - 1 || !(orientation[node] > 0)) return lost;
        const int n = (DIP + LANES - 1) & -LANES;
        for (int i = 0; i < n; i++) {
            double place = node - 1 + 2.0 * (i < DIP ? i : DIP - 1) / (DIP - 1);
            place = place > 0 ? place < RADII - 1 ? place : RADII - 1 : 0;
            const double radius = radius_at(radii, place);
            x[i] = a * radius, y[i] = b * radius;
        }
        lens_double(c, 1, n, x, y, u, v, &to, least);
        for (int i = 0; i < DIP; i++)
            if (!(least[i] > 0)) return lost;
        spared[node] = 1;
    }
}

/* Whether all stages are defined at a point */
static int defined_at(const Camera_double *c, double a, double b) {
    ALIGNED double x[BLOCK], y[BLOCK], u[BLOCK], v[BLOCK];
    for (int i = 0; i < LANES; i++) x[i] = a, y[i] = b;
    for (int j = 1; j <= c->stages; j++) {
        const double *k = c->numbers[j];
        const Part *part = c->parts + j;
        if (part->kind == HOMOGRAPHY && !(k[6] * x[0] + k[7] * y[0] + k[8] > 0)) return 0;
        if (part->factor == RATIONAL && !(horner_double(k + part->n, part->m, x[0] * x[0] + y[0] * y[0], NULL) > 0)) return 0;
        stage_double(c, j, LANES, x, y, u, v, NULL);
        memcpy(x, u, LANES * sizeof(double)), memcpy(y, v, LANES * sizeof(double));
    }
    return 1;
}

/* The radii: over the whole chart and, where the factor has a fold, more of them the nearer to it */
static void radii_around(const Domain *d, double fold, double end, double *radii) {
    const int half = RADII / 2;
    if (!(fold == fold)) { /* no factor */
        memcpy(radii, d->even, RADII * sizeof(double));
        return;
    }
    const double last = d->radii[MOST_RADII - 1], middle = fold < end ? fold : 1; /* which does no harm */
    double close[RADII / 2];
    for (int i = 0; i < half; i++) {
        const double share = -1 + 2.0 * i / (half - 1), radius = middle * (1 + 0.5 * share * share * share);
        close[i] = radius < last ? radius : last;
    }
    for (int i = 0, j = 0, k = 0; k < RADII; k++) /* both are ascending */
        radii[k] = j == half || (i < half && d->coarse[i] <= close[j]) ? d->coarse[i++] : close[j++];
}

/* How far the image reaches in each direction, of how far azimuths go and where they end */
static void envelope_of(const double *furthest, const double *x, const double *y, double *envelope) {
    int leaps = 0, turns = 0, here[AZIMUTHS];
    double highest = 0;
    for (int i = 0; i < AZIMUTHS; i++) {
        const int is_finite = fabs(x[i]) < INFINITY, other = fabs(y[i]) < INFINITY;
        here[i] = azimuth_double(is_finite ? x[i] : 0, other ? y[i] : 0, 0), envelope[i] = 0;
    }
    for (int i = 0; i < AZIMUTHS; i++) {
        const int next = (i + 1) % AZIMUTHS;
        const int turn = (here[next] - here[i] + AZIMUTHS + AZIMUTHS / 2) % AZIMUTHS - AZIMUTHS / 2;
        const double level = furthest[i] > furthest[next] ? furthest[i] : furthest[next];
        turns += turn, leaps |= level == INFINITY || abs(turn) > SPAN - ASIDE, highest = level > highest ? level : highest;
        for (int step = (turn < 0 ? turn : 0) - ASIDE; step <= (turn > 0 ? turn : 0) + ASIDE; step++) {
            if (abs(step) > SPAN) continue;
            double *at = envelope + (here[i] + step + AZIMUTHS) % AZIMUTHS;
            *at = level > *at ? level : *at;
        }
    }
    for (int i = 0; i < AZIMUTHS; i++) {
        const double level = BEYOND * (leaps || turns != AZIMUTHS ? highest : envelope[i]);
        envelope[i] = level < FAR_IMAGE ? level : INFINITY;
    }
}

/* `limits2` and `extent` of a camera; fold: of its first stage's factor, NAN where it has none */
static void follow(const Domain *d, int64_t camera, const Camera_double *c, double fold, double end) {
    const int is_double = (int)d->is_double;
    const int64_t first = camera * EXTENT, table = first + RADII;
    double radii[RADII], lost[AZIMUTHS], furthest[AZIMUTHS], last_x[AZIMUTHS], last_y[AZIMUTHS], envelope[AZIMUTHS];
    radii_around(d, fold, end, radii);
    for (int i = 0; i < RADII; i++) put(d->extent, first + i, radii[i], is_double);
    for (int i = 0; i < AZIMUTHS; i++) {
        ALIGNED double x[BLOCK], y[BLOCK], u[BLOCK], v[BLOCK], least[BLOCK];
        Jacobian_double to;
        const double turn = i * (4.0 / AZIMUTHS), across = fabs(turn - 2) - 1, down = 1 - fabs(fmod(turn + 1, 4) - 2);
        const double size = hypot(across, down), a = across / size, b = down / size;
        for (int k = 0; k < RADII; k++) x[k] = a * radii[k], y[k] = b * radii[k];
        lens_double(c, 1, RADII, x, y, u, v, &to, least);
        lost[i] = loss_on(c, a, b, radii, least);
        double last = radius_at(radii, lost[i] < RADII - 1 ? lost[i] : RADII - 1), before = 0, highest = 0;
        last = last < end ? last : end;
        for (int k = 0; k < RADII; k++) {
            double reach = sqrt(u[k] * u[k] + v[k] * v[k]);
            if (radii[k] < last && k < lost[i] && reach < INFINITY) before = reach > before ? reach : before;
            if (!(k < lost[i] && reach < INFINITY)) reach = INFINITY;
            highest = reach > highest ? reach : highest;
            put(d->extent, table + i * RADII + k, highest, is_double);
        }
        for (int k = 0; k < LANES; k++) x[k] = a * last, y[k] = b * last;
        lens_double(c, 1, LANES, x, y, u, v, NULL, NULL);
        const double reach = sqrt(u[0] * u[0] + v[0] * v[0]);
        double next = radii[lost[i] < RADII - 1 ? (int)ceil(lost[i]) : RADII - 1];
        next = next < end ? next : end;
        /* before a pole there is no end to it */
        furthest[i] = reach == reach && defined_at(c, a * next, b * next) ? reach > before ? reach : before : INFINITY;
        last_x[i] = u[0], last_y[i] = v[0];
    }
    envelope_of(furthest, last_x, last_y, envelope);
    for (int i = 0; i < AZIMUTHS; i++) {
        const int other = (i + 1) % AZIMUTHS;
        const double one = radius_at(radii, lost[i]), two = radius_at(radii, lost[other]);
        const double nearer = one < two ? one : two, further = one < two ? two : one;
        const int smooth = fabs(lost[i] - lost[other]) <= 1.5 || further <= (1 + SMOOTH) * nearer;
        double limit = smooth ? further * (1 + BULGE) : nearer;
        limit = limit < end ? limit : end;
        put(d->limits2, camera * AZIMUTHS + i, limit * limit, is_double);
        put(d->extent, table + AZIMUTHS * RADII + i, envelope[i], is_double);
    }
}

/* The same of a lens that goes stage by stage, and asks for neither */
static void follow_nothing(const Domain *d, int64_t camera) {
    for (int i = 0; i < AZIMUTHS; i++) put(d->limits2, camera * AZIMUTHS + i, 0, (int)d->is_double);
    for (int i = 0; i < EXTENT; i++) put(d->extent, camera * EXTENT + i, 0, (int)d->is_double);
}

/* The lens of a camera, for the loops over points */
static void lens_of(const Domain *d, int64_t camera, Camera_double *c) {
    const double *numbers = d->parameters + camera * d->parameter_count;
    memset(c, 0, sizeof *c);
    c->parts = d->parts, c->stages = (int)d->part_count - 1;
    c->constants = d->constants + camera * d->constant_count;
    for (int j = 0; j <= c->stages; j++) c->numbers[j] = numbers, numbers += numbers_of(c->parts + j);
    for (int j = 1; j <= c->stages; j++) prepare_stage_double(c, j);
}
