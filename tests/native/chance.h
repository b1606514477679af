/* Chance for random jobs, each from its number, and the loop over them. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

static uint64_t state; /* splitmix64 */

static uint64_t bits(void) {
    uint64_t z = (state += 0x9e3779b97f4a7c15u);
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}

static int64_t below(int64_t n) { return (int64_t)(bits() % (uint64_t)n); }
static double share(void) { return (double)(bits() >> 11) / 9007199254740992.0; }

/* Called as: PROGRAM FIRST COUNT, the numbers of the jobs. 1, and the number of the job, where one is not fine */
static int all_jobs(char **words, int (*job)(void)) {
    const uint64_t first = strtoull(words[1], NULL, 10), jobs = strtoull(words[2], NULL, 10);
    for (uint64_t number = first; number < first + jobs; number++) {
        state = number;
        if (job()) continue;
        printf("job %llu\n", (unsigned long long)number);
        return 1;
    }
    return 0;
}
