/* The inverse of a lens for the few pixels that a table and a few steps leave open; projection/solve.py, which says why. */

/* Which points lie in the domain: before the fold, or before the limit of their azimuth and regular */
static void T(contained)(const T(Camera) *c, int n, const R *restrict a, const R *restrict b, const R *restrict least,
                         I *restrict ok) {
    const R safe_radius_sq = c->safe_radius_sq;
    EACH(i) ok[i] = safe_radius_sq - (a[i] * a[i] + b[i] * b[i]) > 0;
    if (!c->follows) return;
    for (int i = 0; i < n; i++)
        if (!ok[i] && least[i] > TINY) ok[i] = c->limits2[T(azimuth)(a[i], b[i], 0)] - (a[i] * a[i] + b[i] * b[i]) > 0;
}

/* The radius at which a lens nearly reaches `target` on the azimuth of (a, b), before its fold */
static R T(reached)(const T(Camera) *c, R target, R a, R b) {
    const R *radii = c->extent, *reach = radii + RADII + T(azimuth)(a, b, 0.5) * RADII;
    int low = 0, high = RADII - 1;
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (reach[middle] > target) high = middle;
        else low = middle;
    }
    const R near = reach[low], far = reach[low + 1];
    R share = far < INFINITY ? (target - near) / (far > near ? far - near : 1) : 0;
    share = share > 0 ? share < 1 ? share : 1 : 0;
    return radii[low] + share * (radii[low + 1] - radii[low]);
}

/* Whichever of some points comes nearest, each on another azimuth, that the lens sends as far out as (u, v) */
static void T(begin)(const T(Camera) *c, int n, const R *restrict u, const R *restrict v, R *restrict a, R *restrict b) {
    ALIGNED R p[BLOCK], q[BLOCK], x[BLOCK], y[BLOCK], best[BLOCK], turn[BLOCK], step[BLOCK], last[BLOCK];
    const R close2 = (R)(0.02 * 0.02);
    EACH(i) {
        a[i] = b[i] = step[i] = last[i] = 0;
        best[i] = u[i] * u[i] + v[i] * v[i];
        turn[i] = (R)atan2(v[i], u[i]);
    }
    for (int round = 0; round < START_ROUNDS; round++) {
        I any = 0;
        for (int i = 0; i < n; i++) {
            const R across = (R)cos(turn[i]), down = (R)sin(turn[i]);
            const R rho = T(reached)(c, T(root)(u[i] * u[i] + v[i] * v[i]), across, down);
            p[i] = rho * across, q[i] = rho * down;
        }
        T(lens)(c, 1, n, p, q, x, y, NULL, NULL);
        EACH(i) {
            const R error = (u[i] - x[i]) * (u[i] - x[i]) + (v[i] - y[i]) * (v[i] - y[i]);
            const R away2 = close2 * (u[i] * u[i] + v[i] * v[i]);
            const I far = (round == 0) | (best[i] > away2), better = far & (error < best[i]);
            a[i] = better ? p[i] : a[i], b[i] = better ? q[i] : b[i], best[i] = better ? error : best[i];
            any |= best[i] > away2;
        }
        if (!any) break;
        for (int i = 0; i < n; i++) {
            const R off = (R)atan2(x[i] * v[i] - y[i] * u[i], x[i] * u[i] + y[i] * v[i]);
            R slope = step[i] != 0 ? (last[i] - off) / step[i] : 1;
            slope = slope > (R)0.05 ? slope < 2 ? slope : 2 : (R)0.05;
            const R ahead = off / slope;
            step[i] = ahead > -1 ? ahead < 1 ? ahead : 1 : -1, last[i] = off, turn[i] += step[i];
        }
    }
}

/* Newton's method; each step is shortened until it comes nearer, in Deuflhard's sense, and stays in the domain */
static void T(damped)(const T(Camera) *c, int n, const R *restrict u, const R *restrict v, R *restrict a, R *restrict b) {
    ALIGNED R x[BLOCK], y[BLOCK], p[BLOCK], q[BLOCK], next_x[BLOCK], next_y[BLOCK], da[BLOCK], db[BLOCK], least[BLOCK];
    ALIGNED R length[BLOCK];
    ALIGNED I good[BLOCK];
    T(Jacobian) at, next;
    T(lens)(c, 1, n, a, b, x, y, &at, NULL);
    EACH(i) length[i] = 1;
    for (int count = 0; count < DAMPED_STEPS; count++) {
        I any = 0;
        EACH(i) {
            T(step)(at.ua[i], at.ub[i], at.va[i], at.vb[i], u[i] - x[i], v[i] - y[i], da + i, db + i);
            p[i] = a[i] + length[i] * da[i], q[i] = b[i] + length[i] * db[i];
        }
        T(lens)(c, 1, n, p, q, next_x, next_y, &next, least);
        T(contained)(c, n, p, q, least, good);
        EACH(i) {
            const R off = T(most)(T(absolute)(u[i] - x[i]), T(absolute)(v[i] - y[i]));
            const R enough = 4 * EPS * (1 + T(most)(T(absolute)(u[i]), T(absolute)(v[i])));
            const I moves = (off > enough) & (length[i] > (R)1e-4);
            R ahead_a, ahead_b;
            T(step)(at.ua[i], at.ub[i], at.va[i], at.vb[i], u[i] - next_x[i], v[i] - next_y[i], &ahead_a, &ahead_b);
            good[i] &= moves & (ahead_a * ahead_a + ahead_b * ahead_b < da[i] * da[i] + db[i] * db[i]);
            length[i] = !moves ? length[i] : !good[i] ? length[i] / 4 : length[i] < (R)0.25 ? length[i] * 4 : 1;
            any |= moves;
            a[i] = good[i] ? p[i] : a[i], b[i] = good[i] ? q[i] : b[i];
            x[i] = good[i] ? next_x[i] : x[i], y[i] = good[i] ? next_y[i] : y[i];
            at.ua[i] = good[i] ? next.ua[i] : at.ua[i], at.ub[i] = good[i] ? next.ub[i] : at.ub[i];
            at.va[i] = good[i] ? next.va[i] : at.va[i], at.vb[i] = good[i] ? next.vb[i] : at.vb[i];
        }
        if (!any) break;
    }
}

/* Where the first stage sends points in a bracket up to its fold; `ok` where it can */
static void T(by_radius)(const T(Camera) *c, int n, const R *restrict u, const R *restrict v, R *restrict a,
                         R *restrict b, I *restrict ok) {
    const R fold2 = c->safe_radius_sq * (1 - 64 * EPS), most2 = c->table[1] * (1 + 64 * EPS);
    ALIGNED R p[BLOCK], q[BLOCK], r2[BLOCK], scale[BLOCK], x[BLOCK], y[BLOCK];
    T(Jacobian) to;
    EACH(i) p[i] = u[i], q[i] = v[i], ok[i] = 1;
    if (!c->is_radial) {
        T(start)(c, 2, n, u, v, p, q);
        for (int count = 0; count < 12; count++) { /* the first ones may take off no more than a third */
            T(lens)(c, 2, n, p, q, x, y, &to, NULL);
            EACH(i) {
                R dp, dq;
                T(step)(to.ua[i], to.ub[i], to.va[i], to.vb[i], u[i] - x[i], v[i] - y[i], &dp, &dq);
                p[i] += dp, q[i] += dq;
            }
        }
        EACH(i) {
            ok[i] = (u[i] * u[i] + v[i] * v[i] <= c->image_circle_sq) & (p[i] * p[i] + q[i] * q[i] <= most2);
            p[i] = ok[i] ? p[i] : 0, q[i] = ok[i] ? q[i] : 0;
        }
    }
    EACH(i) r2[i] = p[i] * p[i] + q[i] * q[i];
    T(bracketed)(c->factors + 1, fold2, n, r2, scale);
    EACH(i) a[i] = p[i] * scale[i], b[i] = q[i] * scale[i];
}

static void T(search)(const T(Camera) *c, int n, const R *restrict u, const R *restrict v, R *restrict a, R *restrict b,
                      I *restrict ok) {
    ALIGNED R x[BLOCK], y[BLOCK], stretch[BLOCK], least[BLOCK], p[BLOCK], q[BLOCK];
    ALIGNED I inside[BLOCK];
    T(Seen) s;
    T(Jacobian) to;
    if (c->follows) {
        EACH(i) ok[i] = 1;
        T(Camera) endless = *c; /* on the way a point may be behind the edge, where the formula goes on */
        endless.ends = 0;
        T(begin)(c, n, u, v, a, b);
        T(damped)(&endless, n, u, v, a, b);
    } else T(by_radius)(c, n, u, v, a, b, ok);
    T(lens)(c, 1, n, a, b, x, y, &to, least);
    T(contained)(c, n, a, b, least, inside);
    EACH(i) {
        const R across = T(absolute)(to.ua[i]) + T(absolute)(to.ub[i]), down = T(absolute)(to.va[i]) + T(absolute)(to.vb[i]);
        stretch[i] = T(most)(across, down) * T(most)(T(absolute)(a[i]), T(absolute)(b[i]));
        ok[i] &= inside[i];
    }
    for (int count = 0; count < 2; count++) { /* what rounding left */
        EACH(i) {
            R da, db;
            T(step)(to.ua[i], to.ub[i], to.va[i], to.vb[i], u[i] - x[i], v[i] - y[i], &da, &db);
            a[i] = ok[i] ? a[i] + da : 0, b[i] = ok[i] ? b[i] + db : 0;
        }
        T(lens)(c, 1, n, a, b, x, y, NULL, NULL);
    }
    /* next to a fold the polished solution may lie on its other side: what counts is where its ray is seen */
    T(rays)(c, n, a, b, ok, s.x, s.y, s.z);
    T(to_plane_block)(c, 0, n, n, &s);
    EACH(i) ok[i] &= s.ok[i] == 1;
    if (c->follows) { /* away from it, where another processor's rounding would carry the ray across */
        EACH(i) p[i] = s.a[i] * (1 + 32 * EPS), q[i] = s.b[i] * (1 + 32 * EPS);
        T(lens)(c, 1, n, p, q, x, y, &to, least);
        T(contained)(c, n, p, q, least, inside);
        EACH(i) ok[i] &= inside[i];
    }
    T(lens)(c, 1, n, s.a, s.b, x, y, NULL, NULL);
    EACH(i) {
        const R du = T(absolute)(x[i] - u[i]), dv = T(absolute)(y[i] - v[i]);
        const R far = T(most)(T(absolute)(u[i]), T(absolute)(v[i]));
        ok[i] &= T(most)(du, dv) <= 32 * EPS * (1 + far + stretch[i]);
        a[i] = ok[i] ? a[i] : 0, b[i] = ok[i] ? b[i] : 0;
    }
}
