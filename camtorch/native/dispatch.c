/* The entry points: each is that of the best variant that this CPU can run, or of the one that was asked for. */
#include <layout.h> /* which the build makes of these headers, see headers.py: sizes and offsets by the names of fields */
#include <stddef.h>
#include <string.h>
#if defined(HAS_AVX512) || defined(HAS_AVX2)
#include <cpuid.h>
#endif

#include "consensus.h"
#include "draws.h"
#include "geometry.h"
#include "poses.h"
#include "sampler.h"
#include "small.h"

#ifdef HAS_AVX512
#define IF_AVX512(...) __VA_ARGS__
#else
#define IF_AVX512(...)
#endif
#ifdef HAS_AVX2
#define IF_AVX2(...) __VA_ARGS__
#else
#define IF_AVX2(...)
#endif

/* The result, the name and the argument of each entry */
#define EACH_ENTRY(ENTRY)                                                                                              \
    ENTRY(int32_t, sample, Job *)                                                                                      \
    ENTRY(void, sample_images, const Images *)                                                                         \
    ENTRY(int32_t, classify, const Classification *)                                                                   \
    ENTRY(void, lay, Laying *)                                                                                         \
    ENTRY(int64_t, geometry, const Rows *)                                                                             \
    ENTRY(int64_t, moves, const Move *)                                                                                \
    ENTRY(int64_t, lattices, const Lattices *)                                                                         \
    ENTRY(void, domain, const Domain *)                                                                                \
    ENTRY(int64_t, draws, Draws *)                                                                                     \
    ENTRY(void, consensus, const Agreement *)                                                                          \
    ENTRY(void, poses, const Poses *)                                                                                  \
    ENTRY(void, views, const Views *)                                                                                  \
    ENTRY(void, steps, const Steps *)

#define DECLARED(result, name, type)                                                                                   \
    result name##_baseline(type);                                                                                      \
    IF_AVX2(result name##_avx2(type);)                                                                                 \
    IF_AVX512(result name##_avx512(type);)
EACH_ENTRY(DECLARED)

enum { BASELINE, AVX2, AVX512 };
static const char *const NAMES[] = {"baseline", IF_AVX2([AVX2] = "avx2", ) IF_AVX512([AVX512] = "avx512")};
static int chosen = -1; /* no variant yet */

/* By CPUID itself, as `__builtin_cpu_supports` says no to everything where a compiler's library has no __cpu_model, as zig's;
 * XCR0 says which registers the system keeps: 6 those of AVX, 0xe0 also those of AVX-512 */
static int best(void) {
#if defined(HAS_AVX512) || defined(HAS_AVX2)
    const unsigned first = bit_OSXSAVE | bit_FMA | bit_F16C, second = bit_AVX2 | bit_BMI2;
    unsigned a, b, c, d, kept;
    if (!__get_cpuid(1, &a, &b, &c, &d) || (c & first) != first) return BASELINE;
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || (b & second) != second) return BASELINE;
    __asm__("xgetbv" : "=a"(kept), "=d"(d) : "c"(0));
    if ((kept & 6) != 6) return BASELINE;
#ifdef HAS_AVX512
    const unsigned third = bit_AVX512F | bit_AVX512DQ | bit_AVX512BW | bit_AVX512VL;
    if ((kept & 0xe0) == 0xe0 && (b & third) == third && (c & bit_AVX512VBMI)) return AVX512;
#endif
#ifdef HAS_AVX2
    return AVX2;
#endif
#endif
    return BASELINE;
}

static int variant(void) {
    int now = __atomic_load_n(&chosen, __ATOMIC_RELAXED);
    if (now < 0) __atomic_store_n(&chosen, now = best(), __ATOMIC_RELAXED);
    return now;
}

/* Chooses the variant of that name for all calls; 0 if this CPU cannot run it, or the library has none */
EXPORTED int32_t camtorch_use(const char *name) {
    for (int i = best(); i >= 0; i--)
        if (NAMES[i] && !strcmp(NAMES[i], name)) {
            __atomic_store_n(&chosen, i, __ATOMIC_RELAXED);
            return 1;
        }
    return 0;
}

/* In one row, which .ci/wheels.py looks for in a library of another machine */
static const uint32_t BUILT_FROM[] = {SOURCES, CHECKSUM, OFFSETS};

EXPORTED unsigned camtorch_sources(void) { return BUILT_FROM[0]; }

/* A checksum of the structures; `layout` of structure.py is of those of Python */
EXPORTED unsigned camtorch_layout(void) {
    uint32_t sum = BUILT_FROM[1];
    for (size_t i = 2; i < sizeof BUILT_FROM / sizeof *BUILT_FROM; i++) sum = (sum ^ BUILT_FROM[i]) * 16777619u;
    return sum;
}

EXPORTED const char *camtorch_variant(void) { return NAMES[variant()]; }

#define CALLED(result, name, type)                                                                                     \
    EXPORTED result camtorch_##name(type given) {                                                                      \
        switch (variant()) {                                                                                           \
            IF_AVX512(case AVX512: return name##_avx512(given);)                                                       \
            IF_AVX2(case AVX2: return name##_avx2(given);)                                                             \
        default: return name##_baseline(given);                                                                        \
        }                                                                                                              \
    }
EACH_ENTRY(CALLED)

/* Rotations (n, 3, 3) after turns of n steps, `width` apart */
EXPORTED void camtorch_turns(const double *steps, int64_t width, double *rotations, int64_t count) {
    for (int64_t i = 0; i < count; i++) turn(steps + i * width, rotations + 9 * i, 3);
}

/* -- one sample */

/* The positions of a lattice in float, for samplers: in place, plane by plane */
static void narrowed(double *exact, int64_t count) {
    for (int64_t i = 0; i < count; i++) {
        const float value = (float)exact[i];
        memcpy((char *)exact + i * (int64_t)sizeof value, &value, sizeof value);
    }
}

/* As torch turns them: rounded once in each step, or, where one is not finite, twice */
#define TURNED(R, fused)                                                                                               \
    static void turned_##R(const Turned *given) {                                                                      \
        const R *m = given->turn;                                                                                      \
        const int64_t by = given->strides[0], to = given->strides[1];                                                  \
        int all = 1;                                                                                                   \
        for (int64_t i = 0; i < given->count; i++)                                                                     \
            for (int k = 0; k < 3; k++) all &= isfinite(((const R *)given->rows)[i * by + k * to]) != 0;               \
        for (int64_t i = 0; i < given->count; i++) {                                                                   \
            const R *v = (const R *)given->rows + i * by, x = v[0], y = v[to], z = v[2 * to];                          \
            const int known = isfinite(x) && isfinite(y) && isfinite(z);                                               \
            for (int k = 0; k < 3; k++) {                                                                              \
                const R *row = m + 3 * k, found = all ? fused(row[2], z, fused(row[1], y, row[0] * x))                 \
                                                      : row[0] * x + row[1] * y + row[2] * z;                          \
                ((R *)given->results)[i * by + k * to] = known ? found : (R)NAN;                                       \
            }                                                                                                          \
        }                                                                                                              \
    }
TURNED(float, fmaf)
TURNED(double, fma)

/* Rotations that turn, by vectors */
static void turned_rotations(const Turned *given) {
    const int64_t is_double = given->is_double, to = given->strides[1];
    double turn[9], rotation[9], vector[3];
    int still = 1;
    for (int i = 0; i < 9; i++) turn[i] = number(given->turn, i, is_double), still &= turn[i] == (i % 4 == 0);
    for (int64_t i = 0, at = 0; i < given->count && !still; i++, at += given->strides[0]) {
        for (int k = 0; k < 3; k++) vector[k] = number(given->rows, at + k * to, is_double);
        matrix_of(vector, rotation);
        multiplied(turn, rotation, rotation);
        vector_of(rotation, vector);
        for (int k = 0; k < 3; k++) put(given->results, at + k * to, vector[k], is_double);
    }
}

/* Whether no rotation is more than two turns, as those in degrees are; `check_radians` */
static int are_radians(const Turned *given) {
    const double most = 157.91367041742974 * (1 + 1e-6); /* (4 pi)^2 */
    int all = 1;
    for (int64_t i = 0, at = 0; i < given->count; i++, at += given->strides[0]) {
        double square = 0;
        for (int k = 0; k < 3; k++) {
            const double one = number(given->rows, at + k * given->strides[1], given->is_double);
            square += one * one;
        }
        all &= !(square > most); /* or what is not a number */
    }
    return all;
}

/* Whether the first three vectors are the columns of a rotation, up to a rounding of 1e-3 */
static int is_rotation(const Turned *given) {
    double m[3][3], off = 0;
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 3; k++) {
            const int64_t at = i * given->strides[0] + k * given->strides[1];
            m[i][k] = number(given->rows, at, given->is_double);
        }
    for (int i = 0; i < 3; i++)
        for (int j = i; j < 3; j++) {
            const double miss = fabs(m[i][0] * m[j][0] + m[i][1] * m[j][1] + m[i][2] * m[j][2] - (i == j));
            off = miss <= off ? off : miss; /* or what is not a number */
        }
    const double x = m[1][1] * m[2][2] - m[1][2] * m[2][1], y = m[1][2] * m[2][0] - m[1][0] * m[2][2];
    return off < NEARLY_ROTATION && m[0][0] * x + m[0][1] * y + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0]) > 0;
}

/* A lattice, the images that are sampled on it, and other pixels of the same cameras, in one call on this thread: in between
 * caches stay warm. Flags of `lattices`, and then nothing is made; or those of `moves`, LEFT_BITS higher */
EXPORTED int64_t camtorch_together(const Together *given) {
    const Lattices *lattices = &given->lattices;
    int64_t left = 0;
    *lattices->used = 0;
    if (given->job_count) left = camtorch_lattices(lattices);
    if (left) return left;
    if (given->job_count && lattices->narrow)
        for (int c = 0; c < 2; c++)
            narrowed((double *)lattices->exact + c * SQUARES * lattices->cells.rows * lattices->cells.columns,
                     SQUARES * *lattices->used);
    const Images images = {given->jobs, given->is_whole ? given->job_count : 0, 0};
    camtorch_sample_images(&images);
    for (int64_t i = 0; i < given->move_count; i++) left |= camtorch_moves(given->moves + i);
    for (const Turned *one = given->turned; one < given->turned + given->turned_count; one++) {
        left |= one->form == POSE && !is_rotation(one) ? LEFT_LABELS : 0;
        left |= one->form == ROTATION_VECTORS && !are_radians(one) ? LEFT_LABELS : 0;
        if (one->turn && one->form == ROTATION_VECTORS) turned_rotations(one);
        else if (one->turn) (one->is_double ? turned_double : turned_float)(one);
    }
    return left << LEFT_BITS;
}
