/* Elementary functions of R, float or double, to about one unit in the last place, without branches. Polynomials are
 * minimax ones, made with mpmath's chebyfit to a tenth of that, on the intervals that are named.
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
INLINE R T(most)(R x, R y) { return x > y ? x : y; }
INLINE R T(least)(R x, R y) { return x < y ? x : y; }

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

/* The angle of (x, y), in -pi .. pi. Both zero, or infinite: not a number */
INLINE R T(atan2)(R y, R x) {
    const R across = T(absolute)(y), ahead = T(absolute)(x);
    const int steep = across > ahead;
    const R larger = steep ? across : ahead, smaller = steep ? ahead : across;
    /* atan(q) = pi/4 + atan((q - 1) / (q + 1)): what is left is at most tan(pi/8) */
    const int wide = smaller > (R)0.41421356237309503 * larger;
    const R t = (wide ? smaller - larger : smaller) / (wide ? smaller + larger : larger), s = t * t;
    R sum, eighths = wide ? 1 : 0, sign = 1; /* quarters of pi */
#if IS_DOUBLE
    sum = 0.0162843750500433944;
    sum = sum * s - 0.0345693150633260898, sum = sum * s + 0.0455154473402216165, sum = sum * s - 0.0523044364068694771;
    sum = sum * s + 0.0587892755447380676, sum = sum * s - 0.0666642476020052014, sum = sum * s + 0.0769229636804229712;
    sum = sum * s - 0.0909090875325911294, sum = sum * s + 0.111111111051505879, sum = sum * s - 0.142857142856597778;
    sum = sum * s + 0.199999999999998043, sum = sum * s - 0.333333333333333332;
    const R high = 0.7853981633974482789994909, low = 3.06161699786838302e-17; /* of pi/4; times 4 without rounding */
#else
    sum = -0.0645171886935895807f;
    sum = sum * s + 0.107436683248300981f, sum = sum * s - 0.14263949753605724f, sum = sum * s + 0.199995403149579694f;
    sum = sum * s - 0.333333317604345559f;
    const R high = 0.78539800643920898438f, low = 1.56958239325240661e-7f;
#endif
    sum = t + t * s * sum;
    eighths = steep ? 2 - eighths : eighths, sign = steep ? -sign : sign;
    eighths = x < 0 ? 4 - eighths : eighths, sign = x < 0 ? -sign : sign;
    sum = eighths * high + (eighths * low + sign * sum);
    return y < 0 ? -sum : sum;
}

/* Sine and cosine of an angle of a few turns at the most */
INLINE void T(turn)(R angle, R *sine, R *cosine) {
#if IS_DOUBLE
    const R whole = 6755399441055744.0; /* adding it rounds to integers */
    const R quarters = (angle * 0.63661977236758134308 + whole) - whole;
    const R r = ((angle - quarters * 1.57079632673412561417) - quarters * 6.07710050630396597660e-11) -
                quarters * 2.0222662487959507e-21;
    const R s = r * r;
    R of_sine = 1.59179899793974333e-10, of_cosine = -1.13825446453492504e-11;
    of_sine = of_sine * s - 2.50511298964501863e-8, of_sine = of_sine * s + 2.75573160931984052e-6;
    of_sine = of_sine * s - 0.000198412698367405321, of_sine = of_sine * s + 0.00833333333333093655;
    of_sine = of_sine * s - 0.166666666666666646;
    of_cosine = of_cosine * s + 2.08761450494131791e-9, of_cosine = of_cosine * s - 2.755731726587808e-7;
    of_cosine = of_cosine * s + 0.0000248015872987544012, of_cosine = of_cosine * s - 0.00138888888888873898;
    of_cosine = of_cosine * s + 0.0416666666666666654;
#else
    const R whole = 12582912.0f;
    const R quarters = (angle * 0.636619772f + whole) - whole;
    const R r = ((angle - quarters * 1.570556640625f) - quarters * 2.396702766418457e-4f) - quarters * 1.5893254773528197e-8f;
    const R s = r * r;
    R of_sine = -0.000195876390987376193f, of_cosine = 0.000024547689772460029f;
    of_sine = of_sine * s + 0.00833274710466453002f, of_sine = of_sine * s - 0.166666646563122088f;
    of_cosine = of_cosine * s - 0.00138883018675623691f, of_cosine = of_cosine * s + 0.0416666646534887929f;
#endif
    of_sine = r + r * s * of_sine, of_cosine = 1 - s * (R)0.5 + s * s * of_cosine;
    /* which quarter it is, by parts: 0 or 1, and 0 or 2 of quarters modulo 4 */
    const R half = (quarters * (R)0.5 + whole) - whole;      /* quarters / 2, a tie to the even one */
    const R odd = T(absolute)(quarters - 2 * half);          /* 0 or 1 */
    const R even_part = (quarters - odd) * (R)0.5;           /* the quarter below, halved: its parity is the sign */
    const R twice = (even_part * (R)0.5 + whole) - whole;
    const int turned = T(absolute)(even_part - 2 * twice) > (R)0.25;
    const R a = odd > (R)0.5 ? of_cosine : of_sine, b = odd > (R)0.5 ? -of_sine : of_cosine;
    *sine = turned ? -a : a, *cosine = turned ? -b : b;
}

/* The sum over a block of products, by lanes: alike for each compiler */
static double T(dot)(int n, const R *restrict a, const R *restrict b) {
    R lanes[LANES] = {0};
    double sum = 0;
    for (int i = 0; i < n; i += LANES)
        for (int j = 0; j < LANES; j++) lanes[j] += a[i + j] * b[i + j];
    for (int j = 0; j < LANES; j++) sum += lanes[j];
    return sum;
}

static double T(total)(int n, const R *restrict a) {
    R lanes[LANES] = {0};
    double sum = 0;
    for (int i = 0; i < n; i += LANES)
        for (int j = 0; j < LANES; j++) lanes[j] += a[i + j];
    for (int j = 0; j < LANES; j++) sum += lanes[j];
    return sum;
}
