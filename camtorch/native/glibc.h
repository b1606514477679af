/* Old names of functions of which glibc has newer versions, so that a library also loads where glibc is older than that of
 * its compiler. Both compute the same bits; the older ones set errno too. */
#ifndef CAMTORCH_GLIBC_H
#define CAMTORCH_GLIBC_H

#include <math.h>

#if defined(__GLIBC__) && defined(__x86_64__)
#define OLD_NAME(name) __asm__(".symver " #name ", " #name "@GLIBC_2.2.5")
#elif defined(__GLIBC__) && defined(__aarch64__)
#define OLD_NAME(name) __asm__(".symver " #name ", " #name "@GLIBC_2.17")
#else
#define OLD_NAME(name) _Static_assert(1, "")
#endif

OLD_NAME(hypot); /* version 2.35 */
OLD_NAME(fmod);  /* 2.38 */
OLD_NAME(fmodf);

#endif
