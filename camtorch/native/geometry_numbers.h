/* Elementary functions of R, float or double, without branches: to about two units in the last place, sine and cosine
 * near half a turn to five of 1. Polynomials are minimax ones, made with mpmath's chebyfit to a tenth of that or better.
 */
#undef EPS
#undef FLOOR
#undef TINY
#undef FARTHEST
#undef SQUARABLE
#if IS_DOUBLE
#define EPS DBL_EPSILON
#define FLOOR 1.4916681462400413e-154 /* nothing beside 1, and its reciprocal's square is a number */
#define TINY 1.221338669755462e-77    /* whose square that is */
#define FARTHEST 1e9                  /* a radius on a plane, whose ninth power is a number */
#define SQUARABLE 1.157920892373162e+77
#else
#define EPS FLT_EPSILON
#define FLOOR 1.0842021724855044e-19f
#define TINY 3.2927225399135965e-10f
#define FARTHEST 19112.41165783858f
#define SQUARABLE 4294967231.9999986f
#endif

INLINE R T(absolute)(R x) { return IS_DOUBLE ? (R)fabs(x) : (R)fabsf((float)x); }
INLINE R T(root)(R x) { return IS_DOUBLE ? (R)sqrt(x) : (R)sqrtf((float)x); }
INLINE R T(whole)(R x) { return IS_DOUBLE ? (R)floor(x) : (R)floorf((float)x); }
INLINE R T(most)(R x, R y) { return x > y ? x : y; }
INLINE R T(least)(R x, R y) { return x < y ? x : y; }

/* The end `low` too for what is not a number */
INLINE R T(inside)(R low, R x, R high) {
    const R up = x > low ? x : low;
    return up < high ? up : high;
}

INLINE I T(bits)(R x) {
    I bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

INLINE R T(of_bits)(I bits) {
    R x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

/* One over the largest power of two not above x, at least 2^-126 or 2^-1022: to multiply by it costs no bit */
INLINE R T(shrink)(R x) {
#if IS_DOUBLE
    const I one = (I)1 << 52, turned = ((I)2046 << 52) - (T(bits)(x) & ((I)2047 << 52));
#else
    const I one = (I)1 << 23, turned = ((I)254 << 23) - (T(bits)(x) & ((I)255 << 23));
#endif
    return T(of_bits)(turned < one ? one : turned);
}

/* The angle of (x, y) over `by`, which is positive; y is none less than zero. Both zero, or infinite: not a number */
INLINE R T(angle)(R y, R x, R by) {
    const R ahead = T(absolute)(x);
    const int steep = y > ahead;
    const R larger = steep ? y : ahead, smaller = steep ? ahead : y;
#if IS_DOUBLE
    /* atan(q) = pi/4 + atan((q - 1) / (q + 1)): what is left is at most tan(pi/8) */
    const int wide = smaller > 0.41421356237309503 * larger;
    const R above = wide ? smaller - larger : smaller, below = wide ? smaller + larger : larger;
    const R one = 1 / (below * by), q = above * by * one, s = q * q;
    R sum = 0.0162843750500433944;
    sum = sum * s - 0.0345693150633260898, sum = sum * s + 0.0455154473402216165, sum = sum * s - 0.0523044364068694771;
    sum = sum * s + 0.0587892755447380676, sum = sum * s - 0.0666642476020052014, sum = sum * s + 0.0769229636804229712;
    sum = sum * s - 0.0909090875325911294, sum = sum * s + 0.111111111051505879, sum = sum * s - 0.142857142856597778;
    sum = sum * s + 0.199999999999998043, sum = sum * s - 0.333333333333333332;
    sum = q + q * s * sum, sum = wide ? sum + PI / 4 : sum;
#else
    const R below = larger, one = 1 / (below * by), q = smaller * by * one, s = q * q;
    /* in pairs, of pairs of pairs: a chain of nine steps would be waited for */
    const R s2 = s * s, s4 = s2 * s2;
    const R low = (-0.333333317f + s * 0.199997393f) + s2 * (-0.142785687f + s * 0.110337641f);
    const R high = (-0.0865688043f + s * 0.0625016945f) + s2 * (-0.035871539f + s * 0.0135077714f);
    R sum = low + s4 * (high + s4 * -0.00238699732f);
    sum = q + q * s * sum;
#endif
    sum = steep ? (R)(PI / 2) - sum : sum;
    sum = x < 0 ? (R)PI - sum : sum;
    return sum * below * one;
}

INLINE R T(atan2)(R y, R x) {
    const R angle = T(angle)(T(absolute)(y), x, 1);
    return y < 0 ? -angle : angle;
}

/* sin(angle) / angle and cos(angle) of the square of an angle up to pi: both are entire functions of that */
INLINE void T(turn)(R t, R *sinc, R *cosine) {
#if IS_DOUBLE
    R s = -3.53312654446586996e-23, c = 1.47117781534902730e-24;
    s = s * t + 1.94955401262142007e-20, c = c * t - 8.86090385547150088e-22;
    s = s * t - 8.21961767870926162e-18, c = c * t + 4.10978734263623533e-19;
    s = s * t + 2.81144891647976041e-15, c = c * t - 1.56191571309152628e-16;
    s = s * t - 7.64716329247291777e-13, c = c * t + 4.77947702255812137e-14;
    s = s * t + 1.60590438219419157e-10, c = c * t - 1.14707455848701177e-11;
    s = s * t - 2.50521083851273934e-8, c = c * t + 2.08767569875165742e-9;
    s = s * t + 2.75573192239820158e-6, c = c * t - 2.75573192239797973e-7;
    s = s * t - 1.98412698412698168e-4, c = c * t + 2.48015873015872393e-5;
    s = s * t + 8.33333333333333327e-3, c = c * t - 1.38888888888888886e-3;
    c = c * t + 0.0416666666666666667;
#else
    R s = 1.39421471e-10f, c = -9.92797824e-12f;
    s = s * t - 2.4822229e-8f, c = c * t + 2.06720698e-9f, s = s * t + 2.75456768e-6f, c = c * t - 2.75436934e-7f;
    s = s * t - 1.9841002e-4f, c = c * t + 2.48011194e-5f, s = s * t + 8.33333107e-3f, c = c * t - 1.38888812e-3f;
    c = c * t + 0.0416666662f;
#endif
    s = s * t - (R)(1 / 6.0), c = c * t - (R)0.5;
    *sinc = s * t + 1, *cosine = c * t + 1;
}

INLINE R T(folded)(R *lanes) {
    for (int j = 0; j < 8; j++) lanes[j] += lanes[j + 8];
    for (int j = 0; j < 4; j++) lanes[j] += lanes[j + 4];
    return (lanes[0] + lanes[2]) + (lanes[1] + lanes[3]);
}

/* The sum over a block of products, by lanes: alike for each compiler */
static double T(dot)(int n, const R *restrict a, const R *restrict b) {
    R lanes[LANES] = {0};
    for (int i = 0; i < n; i += LANES)
        for (int j = 0; j < LANES; j++) lanes[j] += a[i + j] * b[i + j];
    return T(folded)(lanes);
}

static double T(total)(int n, const R *restrict a) {
    R lanes[LANES] = {0};
    for (int i = 0; i < n; i += LANES)
        for (int j = 0; j < LANES; j++) lanes[j] += a[i + j];
    return T(folded)(lanes);
}
