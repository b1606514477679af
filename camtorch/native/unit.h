/* What units of C begin with: the names of the variant that is compiled, and words for compilers. What Python passes is in
 * sampler.h, geometry.h and so on.
 */
#ifndef CAMTORCH_UNIT_H
#define CAMTORCH_UNIT_H

#define JOINED_(a, b) a##_##b
#define JOINED(a, b) JOINED_(a, b)
#define THIS(name) JOINED(name, VARIANT)

#define INLINE static inline __attribute__((always_inline))
#define NOT_INLINE __attribute__((noinline))

INLINE float greater(float a, float b) { return a > b ? a : b; }
INLINE float lesser(float a, float b) { return a < b ? a : b; }

#endif
