/* Charts: a ray to a point of a plane, and back; optics/charts.py, unified.py and backprojection.py.
 *
 * Rays come with their largest component from 1 to 2. Most charts scale (x, y): (a, b) = scale (x, y), the scale a
 * function of x^2 + y^2 and z; and rays are (a S, b S, C), S and C functions of a^2 + b^2.
 */

#define NEAR_SIDE (8 * (IS_DOUBLE ? 1.4901161193847656e-08 : 3.4526698300124393e-04)) /* 8 sqrt(eps) */

/* What a chart is made of, by value: loops keep it in registers */
typedef struct {
    R xi, alpha, beta; /* of a unified chart */
    R k;               /* of one division */
    R omega, slope, slope_by_omega, tan2, tan2_by_omega; /* of the fov chart */
} T(Chart);

/* A radial factor, and for which of the loops over factors its numbers are padded with zeros */
typedef struct {
    const Part *part;
    const R *numbers, *constants;
    int form;
    R padded[PADDED];
} T(Factor);

/* A planar stage without its factor */
typedef struct {
    R px, py, s0, s1, s2, s3;
} T(Plane);

/* A camera: its numbers, by parts, and what follows from them alone */
typedef struct {
    const Part *parts;
    int stages, way, swapped, is_radial, by_stages, usable;
    int follows, waits; /* whether the lens is to be followed along each azimuth, and yet has to be */
    int ends;           /* whether it ends at the edge of a surface; not while it is followed */
    const R *numbers[MOST_PARTS], *constants; /* those of the parts */
    T(Factor) factors[MOST_PARTS];
    T(Plane) planes[MOST_PARTS];
    R fx, fy, cx, cy, safe_radius_sq, image_radius_sq, image_circle_sq;
    const R *limits2, *extent, *table;
    R chart_safe_radius_sq, chart_most2;
    const R *chart_table;
    T(Chart) chart;
} T(Camera);

/* The factor of a part and, if it is wanted, its derivative by t, of optics/radial.py; see geometry_lens.h */
static void T(radial)(const T(Factor) *, int, const R *restrict, R *restrict, R *restrict);
static void T(radial_sums)(const T(Factor) *, int, const R *restrict, const R *restrict, double *);

/* What does not hang on the point, in double precision */
static void T(prepare_chart)(T(Camera) *c) {
    const Part *part = c->parts;
    const R *k = c->numbers[0];
    T(Chart) *chart = &c->chart;
    c->way = part->kind;
    if (part->kind == UNIFIED) {
        chart->xi = part->flags & HAS_XI ? *k++ : 0;
        chart->alpha = part->flags & HAS_ALPHA ? *k++ : (R)part->constant;
        chart->beta = part->flags & HAS_BETA ? *k : 1;
        const int fixed = !(part->flags & HAS_ALPHA);
        if (part->flags & HAS_XI) c->way = fixed && chart->alpha == 0 ? SHIFTED : UNIFIED;
        else if (fixed && chart->alpha == (R)0.5 && chart->beta == 1) c->way = HALFWAY;
        else c->way = fixed && chart->alpha == 1 ? SPHERICAL : ENHANCED;
    } else if (part->kind == ONE_DIVISION) {
        chart->k = k[0];
    } else if (part->kind == FOV) {
        const double omega = k[0], t = omega * omega / 4;
        const double tanc = t < 1e-4 ? 1 + t * (1 / 3.0 + t * (2 / 15.0 + t * 17 / 315.0)) : tan(omega / 2) / (omega / 2);
        const double secant2 = 1 + t * tanc * tanc;
        chart->omega = (R)omega, chart->slope = (R)tanc;
        /* the derivative of tan(w) / w, w = omega / 2 */
        chart->slope_by_omega =
            (R)(t < 1e-4 ? omega * (1 / 6.0 + t * (2 / 15.0 + t * 17 / 210.0)) : (secant2 - tanc) / omega);
        chart->tan2 = (R)(4 * t * tanc * tanc), chart->tan2_by_omega = (R)(2 * omega * tanc * secant2);
    }
}

/* The angle over x^2 + y^2's root */
INLINE R T(angle_per_radius)(R rho2, R z) {
    const R rho = T(root)(rho2 + FLOOR);
    return T(angle)(rho, z, rho);
}

/* z' + root where difference = root^2 - z^2, without the cancellation behind */
INLINE R T(sum_of)(R z, R root, R difference) { return z > 0 ? z + root : difference / (z > 0 ? 1 : root - z); }

/* The scale of a ray, and whether it is covered: optics' `margin` > 0 */
INLINE R T(scale)(const T(Chart) k, const int way, R x, R y, R z, I *ok) {
    const R rho2 = x * x + y * y, far = T(most)(T(absolute)(x), T(absolute)(y));
    switch (way) {
    case PERSPECTIVE:
        *ok = FARTHEST * z - far > 0;
        return 1 / z;
    case EQUISOLID: {
        const R distance = T(root)(rho2 + z * z);
        *ok = (z > 0) | (rho2 > FLOOR / EPS);
        return T(root)(2 / (distance * T(sum_of)(z, distance, rho2)));
    }
    case UNIFIED:
    case SHIFTED:
    case SPHERICAL:
    case HALFWAY:
    case ENHANCED: {
        const int has_xi = way == UNIFIED || way == SHIFTED;
        const R distance = has_xi ? T(root)(rho2 + z * z) : 0, w = has_xi ? z + k.xi * distance : z;
        const R alpha = way == HALFWAY ? (R)0.5 : k.alpha, beta = way == HALFWAY ? 1 : k.beta;
        const R sphere = way == SHIFTED ? 0 : T(root)(beta * rho2 + w * w);
        R above = 1, below = way == SHIFTED ? w : way == SPHERICAL ? sphere : w + alpha * (sphere - w), before = 1;
        if (way == UNIFIED || way == ENHANCED || way == HALFWAY) { /* behind, without cancellation */
            const R behind = alpha * alpha * beta * rho2 + (2 * alpha - 1) * (w * w);
            const R sum = alpha * sphere - (1 - alpha) * w;
            above = w > 0 ? 1 : sum, below = w > 0 ? below : behind;
            before = T(least)(alpha * w + (1 - alpha) * sphere, T(most)(w, sum));
        }
        if (way == SPHERICAL) before = w;
        *ok = (FARTHEST * below - far * above > 0) & (before > 0) & (has_xi ? distance + k.xi * z > 0 : 1);
        return above / below;
    }
    case FOV: {
        const R w2 = k.tan2 * rho2, beyond = k.omega * k.omega * FARTHEST * FARTHEST - (R)(PI * PI);
        /* behind the plane of the camera r is up to pi / omega */
        *ok = (FARTHEST * z - far > 0) | ((w2 > FLOOR / EPS) & (beyond > 0));
        return k.slope * T(angle_per_radius)(w2, z);
    }
    case ONE_DIVISION: {
        const R difference = -4 * k.k * rho2, square = difference + z * z;
        const R below = T(sum_of)(z, T(root)(square), difference);
        *ok = (FARTHEST / 2 * below - far > 0) & (square > 0);
        return 2 / below;
    }
    default: /* EQUIDISTANT, and the angle of an INVERTED chart */
        *ok = (z > 0) | (rho2 > FLOOR / EPS);
        return T(angle_per_radius)(rho2, z);
    }
}

/* Points on the plane; the scale of charts that have one */
INLINE void T(to_plane)(const T(Chart) k, const int way, R x, R y, R z, R *a, R *b, R *scale, I *ok) {
    const R across2 = x * x + z * z;
    if (way == CYLINDER) {
        *a = T(atan2)(x, z), *b = y / T(root)(across2), *scale = 1;
        *ok = FARTHEST * T(most)(T(absolute)(x), T(absolute)(z)) - T(absolute)(y) > 0;
    } else if (way == SPHERE) {
        *a = T(atan2)(x, z), *b = T(atan2)(y, T(root)(across2)), *scale = 1;
        *ok = across2 - FLOOR > 0;
    } else {
        *scale = T(scale)(k, way, x, y, z, ok);
        *a = x * *scale, *b = y * *scale;
    }
}

/* Twice the derivative of the scale by x^2 + y^2, and that by z. What cancels on the axis is multiplied by x^2 + y^2.
   by_angle: how much the radius of an inverted chart grows by the angle */
INLINE void T(scale_slopes)(const T(Chart) k, const int way, R x, R y, R z, R s, R by_angle, R *out, R *along) {
    const R rho2 = x * x + y * y;
    switch (way) {
    case PERSPECTIVE:
        *out = 0, *along = -s * s;
        break;
    case EQUISOLID: {
        const R distance2 = rho2 + z * z, distance = T(root)(distance2);
        const R sum = T(sum_of)(z, distance, rho2), twice = s / (2 * distance2);
        *along = -twice * sum;
        /* 1 + z / (2 d) over d (d + z) */
        *out = -twice * (2 * distance + z) / sum;
        break;
    }
    case UNIFIED:
    case SHIFTED:
    case SPHERICAL:
    case HALFWAY:
    case ENHANCED: {
        const int has_xi = way == UNIFIED || way == SHIFTED;
        const R distance = has_xi ? T(root)(rho2 + z * z) : 1, w = has_xi ? z + k.xi * distance : z;
        const R by_below = -s * s, by_root = way == SHIFTED ? 0 : by_below * k.alpha / T(root)(k.beta * rho2 + w * w);
        const R by_w = by_below * (1 - k.alpha) + by_root * w, by_distance = has_xi ? by_w * k.xi / distance : 0;
        *out = by_root * k.beta + by_distance, *along = by_w + by_distance * z;
        break;
    }
    case FOV: {
        const R w2 = k.tan2 * rho2;
        *along = -k.slope / (w2 + z * z);
        *out = -k.tan2 * (*along * z + s) / (w2 + FLOOR);
        break;
    }
    case ONE_DIVISION: {
        const R root = T(root)(z * z - 4 * k.k * rho2);
        *along = -s / root, *out = 2 * k.k * s * s / root;
        break;
    }
    default:
        *along = -by_angle / (rho2 + z * z);
        *out = -(*along * z + s) / (rho2 + FLOOR);
    }
}

/* The cotangents of rays of that of their points (ga, gb) */
INLINE void T(to_plane_vjp)(const T(Chart) k, const int way, R x, R y, R z, R s, R by_angle, R ga, R gb, R *gx, R *gy,
                            R *gz) {
    if (way == CYLINDER || way == SPHERE) {
        const R across2 = x * x + z * z, across = T(root)(across2), turn = ga / across2, length2 = across2 + y * y;
        const R in = way == CYLINDER ? -gb * y / (across2 * across) : -gb * y / (across * length2);
        *gx = turn * z + in * x, *gz = in * z - turn * x;
        *gy = way == CYLINDER ? gb / across : gb * across / length2;
        return;
    }
    const R along = ga * x + gb * y;
    R out, down;
    T(scale_slopes)(k, way, x, y, z, s, by_angle, &out, &down);
    *gx = ga * s + x * along * out, *gy = gb * s + y * along * out, *gz = along * down;
}

/* Adds the cotangents of the chart's numbers; by_angle as of `scale_slopes` */
static void T(to_plane_sums)(const T(Camera) *c, int n, const R *restrict x, const R *restrict y, const R *restrict z,
                             const R *restrict s, const R *restrict by_angle, const R *restrict ga,
                             const R *restrict gb, double *sums) {
    const T(Chart) k = c->chart;
    ALIGNED R w[BLOCK], t[BLOCK], other[BLOCK];
    switch (c->parts->kind) {
    case UNIFIED: {
        EACH(i) {
            const R rho2 = x[i] * x[i] + y[i] * y[i], distance = T(root)(rho2 + z[i] * z[i]);
            const R along = ga[i] * x[i] + gb[i] * y[i];
            const R shifted = z[i] + k.xi * distance, sphere = T(root)(k.beta * rho2 + shifted * shifted);
            const R by_below = -along * s[i] * s[i], by_root = by_below * k.alpha / sphere;
            w[i] = (by_below * (1 - k.alpha) + by_root * shifted) * distance;
            t[i] = by_below * (sphere - shifted);
            other[i] = by_root * rho2 / 2;
        }
        if (c->parts->flags & HAS_XI) *sums++ += T(total)(n, w);
        if (c->parts->flags & HAS_ALPHA) *sums++ += T(total)(n, t);
        if (c->parts->flags & HAS_BETA) *sums += T(total)(n, other);
        break;
    }
    case FOV:
        /* the scale is slope times a function of tan2 rho2 and z */
        EACH(i) {
            const R rho2 = x[i] * x[i] + y[i] * y[i], w2 = k.tan2 * rho2;
            const R by_w = -(s[i] - k.slope * z[i] / (w2 + z[i] * z[i])) / (2 * (w2 + FLOOR));
            w[i] = (ga[i] * x[i] + gb[i] * y[i]) * (s[i] / k.slope * k.slope_by_omega + by_w * rho2 * k.tan2_by_omega);
        }
        *sums += T(total)(n, w);
        break;
    case ONE_DIVISION:
        EACH(i) {
            const R rho2 = x[i] * x[i] + y[i] * y[i];
            w[i] = (ga[i] * x[i] + gb[i] * y[i]) * s[i] * s[i] * rho2 / T(root)(z[i] * z[i] - 4 * k.k * rho2);
        }
        *sums += T(total)(n, w);
        break;
    case INVERTED: /* d(scale) = -scale dR / (R + 2 t R') */
        EACH(i) {
            t[i] = (x[i] * x[i] + y[i] * y[i]) * s[i] * s[i];
            w[i] = -(ga[i] * x[i] + gb[i] * y[i]) * s[i] * by_angle[i];
        }
        T(radial_sums)(c->factors, n, t, w, sums);
        break;
    }
}

/* -- back: points of the plane to rays */

INLINE R T(ahead)(R around, R alpha) {
    /* z' of the ray (a, b, z') whose denominator is 1; two forms of one function, each where it does not cancel */
    const R root = T(root)(1 - (2 * alpha - 1) * around), bend = 2 * alpha - 1;
    const int far = T(absolute)(bend) > (R)0.5;
    return (far ? alpha * root + (alpha - 1) : 1 - alpha * alpha * around) / (far ? bend : alpha * root + (1 - alpha));
}

/* Whether points of the plane are the image of a ray: optics' `on_plane` > 0 */
INLINE I T(on_plane)(const T(Chart) k, const int way, R a, R b) {
    const R r2 = a * a + b * b, far = T(most)(T(absolute)(a), T(absolute)(b)), half_turn = (R)(PI * (1 - (double)EPS));
    switch (way) {
    case PERSPECTIVE: return FARTHEST - far > 0;
    case EQUISOLID: return 4 * (1 - 64 * EPS) * (1 - 64 * EPS) - r2 > 0;
    case UNIFIED:
    case SHIFTED:
    case SPHERICAL:
    case HALFWAY:
    case ENHANCED: {
        const R around = k.beta * r2, margin = 1 - 64 * EPS - (2 * k.alpha - 1) * around;
        const I inside = (FARTHEST / 2 - far > 0) & (margin > 0);
        if (way == SPHERICAL || way == HALFWAY || way == ENHANCED) return inside;
        const R ahead = T(ahead)(around, k.alpha), before = ahead * ahead + (1 - k.xi) * (1 + k.xi) * r2;
        const R reach = T(root)(before > 0 ? before : 0) + k.xi * ahead;
        return inside & (before - 64 * EPS * (r2 + ahead * ahead) > 0) & (reach - 64 * EPS * T(absolute)(ahead) > 0);
    }
    case FOV: return ((R)(PI * PI) - k.omega * k.omega * r2 > 0) & (FARTHEST / 2 - far > 0);
    case ONE_DIVISION: return (1 - 2 * (R)NEAR_SIDE - k.k * r2 > 0) & (FARTHEST / 2 - far > 0);
    case CYLINDER: return (half_turn - T(absolute)(a) > 0) & (FARTHEST - T(absolute)(b) > 0);
    case SPHERE: return (half_turn - T(absolute)(a) > 0) & ((R)(PI / 2) - T(absolute)(b) > 0);
    case INVERTED: return 1; /* see `cover` */
    default: return (R)(PI * PI) - r2 > 0;
    }
}

/* S and C of charts that scale and, if wanted, twice their derivatives by a^2 + b^2 */
INLINE void T(turned)(const T(Chart) k, const int way, R r2, R *s, R *z, R *ds, R *dz) {
    switch (way) {
    case PERSPECTIVE:
    case ONE_DIVISION: {
        const R division = way == ONE_DIVISION ? k.k : 0, h = 1 + division * r2;
        *s = 1 / T(root)(r2 + h * h), *z = h * *s;
        if (ds) *ds = -*s * *s * *s * (1 + 2 * h * division), *dz = 2 * division * *s + h * *ds;
        break;
    }
    case EQUISOLID:
        *s = T(root)(1 - r2 / 4), *z = 1 - r2 / 2;
        if (ds) *ds = -1 / (4 * *s), *dz = -1;
        break;
    case UNIFIED:
    case SHIFTED:
    case SPHERICAL:
    case HALFWAY:
    case ENHANCED: {
        const int has_xi = way == UNIFIED || way == SHIFTED;
        const R h = way == SHIFTED ? 1 : way == HALFWAY ? 1 - r2 / 4 : T(ahead)(k.beta * r2, k.alpha), below = r2 + h * h;
        /* where the line from the shifted centre meets the unit sphere, on the side of the axis */
        const R short_of = (1 - k.xi) * (1 + k.xi), root = way == HALFWAY ? 1 + r2 / 4 : T(root)(has_xi ? h * h + short_of * r2 : below);
        *s = has_xi ? (k.xi * h + root) / below : 1 / root, *z = h * *s - k.xi;
        if (ds) {
            const R by_r2 = -k.alpha * k.beta / (2 * T(root)(1 - (2 * k.alpha - 1) * k.beta * r2)); /* of h */
            const R by_h = (k.xi + h / root - 2 * h * *s) / below;                                 /* of S */
            *ds = (short_of / root - 2 * *s) / below + 2 * by_h * by_r2, *dz = 2 * by_r2 * *s + h * *ds;
        }
        break;
    }
    case FOV: {
        const R omega2 = k.omega * k.omega;
        R sine, cosine;
        T(turn)(omega2 * r2, &sine, &cosine);
        const R across = sine / k.slope, length = 1 / T(root)(r2 * across * across + cosine * cosine);
        *s = across * length, *z = cosine * length;
        if (ds) {
            const R by_across = omega2 * (cosine - sine) / (omega2 * r2 + FLOOR) / k.slope, by_cosine = -omega2 * sine;
            const R by_length =
                -length * length * length * (across * across + r2 * across * by_across + cosine * by_cosine);
            *ds = by_across * length + across * by_length, *dz = by_cosine * length + cosine * by_length;
        }
        break;
    }
    default:
        T(turn)(r2, s, z);
        if (ds) *ds = (*z - *s) / (r2 + FLOOR), *dz = -*s;
    }
}

/* The unit rays of points of the plane */
INLINE void T(to_ray)(const T(Chart) k, const int way, R a, R b, R *x, R *y, R *z) {
    if (way == CYLINDER || way == SPHERE) {
        R sine, cosine, up, across;
        T(turn)(a * a, &sine, &cosine);
        if (way == SPHERE) T(turn)(b * b, &up, &across), up *= b;
        else across = 1 / T(root)(1 + b * b), up = b * across;
        *x = a * sine * across, *y = up, *z = cosine * across;
        return;
    }
    R s;
    T(turned)(k, way, a * a + b * b, &s, z, NULL, NULL);
    *x = a * s, *y = b * s;
}

/* The cotangents of points of the plane of those of their rays */
INLINE void T(to_ray_vjp)(const T(Chart) k, const int way, R a, R b, R gx, R gy, R gz, R *ga, R *gb) {
    if (way == CYLINDER || way == SPHERE) {
        R sine, cosine, up, across;
        T(turn)(a * a, &sine, &cosine), sine *= a;
        if (way == SPHERE) T(turn)(b * b, &up, &across), up *= b;
        else across = 1 / T(root)(1 + b * b), up = b * across;
        const R level = gx * sine + gz * cosine, slant = gy * across - level * up;
        *ga = (gx * cosine - gz * sine) * across;
        /* the latitude of a height b moves by db / (1 + b^2) */
        *gb = way == SPHERE ? slant : slant * across * across;
        return;
    }
    R s, z, ds, dz;
    T(turned)(k, way, a * a + b * b, &s, &z, &ds, &dz);
    const R out = (gx * a + gy * b) * ds + gz * dz;
    *ga = gx * s + a * out, *gb = gy * s + b * out;
}

/* Adds the cotangents of the chart's numbers, but of an inverted chart */
static void T(to_ray_sums)(const T(Camera) *c, int n, const R *restrict a, const R *restrict b, const R *restrict gx,
                           const R *restrict gy, const R *restrict gz, double *sums) {
    const T(Chart) k = c->chart;
    ALIGNED R w[BLOCK], of_alpha[BLOCK], of_beta[BLOCK];
    switch (c->parts->kind) {
    case UNIFIED: {
        const R short_of = (1 - k.xi) * (1 + k.xi);
        EACH(i) {
            const R r2 = a[i] * a[i] + b[i] * b[i], h = T(ahead)(k.beta * r2, k.alpha), below = r2 + h * h;
            const R root = T(root)(h * h + short_of * r2), along = gx[i] * a[i] + gy[i] * b[i] + gz[i] * h; /* by S */
            const R s = (k.xi * h + root) / below;
            const R by_h = along * (k.xi + h / root - 2 * h * s) / below + gz[i] * s;
            const R fold = T(root)(1 - (2 * k.alpha - 1) * k.beta * r2), sphere = T(root)(k.beta * r2 + h * h);
            w[i] = along * (h - k.xi * r2 / root) / below - gz[i];
            of_alpha[i] = -by_h * (sphere - h) * sphere / fold;
            of_beta[i] = -by_h * k.alpha * r2 / (2 * fold);
        }
        if (c->parts->flags & HAS_XI) *sums++ += T(total)(n, w);
        if (c->parts->flags & HAS_ALPHA) *sums++ += T(total)(n, of_alpha);
        if (c->parts->flags & HAS_BETA) *sums += T(total)(n, of_beta);
        break;
    }
    case FOV:
        EACH(i) {
            const R r2 = a[i] * a[i] + b[i] * b[i], angle2 = k.omega * k.omega * r2;
            R sine, cosine;
            T(turn)(angle2, &sine, &cosine);
            const R across = sine / k.slope, length = 1 / T(root)(r2 * across * across + cosine * cosine);
            const R by_across =
                (cosine - sine) / (angle2 + FLOOR) * k.omega * r2 / k.slope - across * k.slope_by_omega / k.slope;
            const R by_cosine = -sine * k.omega * r2;
            const R by_length = -length * length * length * (r2 * across * by_across + cosine * by_cosine);
            w[i] = (gx[i] * a[i] + gy[i] * b[i]) * (by_across * length + across * by_length) +
                   gz[i] * (by_cosine * length + cosine * by_length);
        }
        *sums += T(total)(n, w);
        break;
    case ONE_DIVISION:
        EACH(i) {
            const R r2 = a[i] * a[i] + b[i] * b[i], h = 1 + k.k * r2, s = 1 / T(root)(r2 + h * h);
            const R by_length = -s * s * s * h;
            w[i] = r2 * ((gx[i] * a[i] + gy[i] * b[i]) * by_length + gz[i] * (s + h * by_length));
        }
        *sums += T(total)(n, w);
        break;
    }
}
