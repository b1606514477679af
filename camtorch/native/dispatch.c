/* The entry points: each is that of the best variant that this CPU can run. */
#include "consensus.h"
#include "geometry.h"
#include "poses.h"
#include "sampler.h"
#include "small.h"

#define DECLARED(variant)                                                                                              \
    int32_t sample_##variant(Job *);                                                                                      \
    int32_t classify_##variant(const Classification *);                                                                \
    int64_t geometry_##variant(const Rows *);                                                                          \
    int64_t moves_##variant(const Move *);                                                                             \
    int64_t lattices_##variant(const Lattices *);                                                                      \
    void domain_##variant(const Domain *);                                                                             \
    void consensus_##variant(const Agreement *);                                                                       \
    void poses_##variant(const Poses *);                                                                               \
    void views_##variant(const Views *);                                                                               \
    void steps_##variant(const Steps *);
DECLARED(baseline)
#ifdef HAS_AVX2
DECLARED(avx2)
#endif
#ifdef HAS_AVX512
DECLARED(avx512)
#endif

enum { BASELINE, AVX2, AVX512 };

static int variant(void) {
#if defined(HAS_AVX512) || defined(HAS_AVX2)
    __builtin_cpu_init();
#endif
#ifdef HAS_AVX512
    if (__builtin_cpu_supports("avx512vbmi") && __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2"))
        return AVX512;
#endif
#ifdef HAS_AVX2
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2")) return AVX2;
#endif
    return BASELINE;
}

EXPORTED unsigned camtorch_sources(void) { return SOURCES; }

EXPORTED const char *camtorch_variant(void) {
    static const char *const names[] = {"baseline", "avx2", "avx512"};
    return names[variant()];
}

#define CALLED(name, ...)                                                                                              \
    switch (variant()) {                                                                                               \
        IF_AVX512(case AVX512: return name##_avx512(__VA_ARGS__);)                                                     \
        IF_AVX2(case AVX2: return name##_avx2(__VA_ARGS__);)                                                           \
    default: return name##_baseline(__VA_ARGS__);                                                                      \
    }
#ifdef HAS_AVX512
#define IF_AVX512(code) code
#else
#define IF_AVX512(code)
#endif
#ifdef HAS_AVX2
#define IF_AVX2(code) code
#else
#define IF_AVX2(code)
#endif

EXPORTED int32_t camtorch_sample(Job *job) { CALLED(sample, job) }

EXPORTED int32_t camtorch_classify(const Classification *given) { CALLED(classify, given) }

EXPORTED int64_t camtorch_geometry(const Rows *rows) { CALLED(geometry, rows) }

EXPORTED int64_t camtorch_moves(const Move *move) { CALLED(moves, move) }

EXPORTED int64_t camtorch_lattices(const Lattices *given) { CALLED(lattices, given) }

EXPORTED void camtorch_domain(const Domain *domain) { CALLED(domain, domain) }

EXPORTED void camtorch_consensus(const Agreement *given) { CALLED(consensus, given) }

EXPORTED void camtorch_poses(const Poses *given) { CALLED(poses, given) }

EXPORTED void camtorch_views(const Views *given) { CALLED(views, given) }

EXPORTED void camtorch_steps(const Steps *given) { CALLED(steps, given) }

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

/* A lattice, the images that are sampled on it, and other pixels of the same cameras, in one call on this thread: in between
 * caches stay warm. Flags of what is left, as of lattices, and then nothing is made; or as of moves, LEFT_BITS higher */
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
    for (int64_t i = 0; i < given->job_count && given->is_whole; i++) given->jobs[i].next = 0, camtorch_sample(given->jobs + i);
    for (int64_t i = 0; i < given->move_count; i++) left |= camtorch_moves(given->moves + i);
    return left << LEFT_BITS;
}
