/* Preloaded (LD_PRELOAD): the process's wall clock is CLOCK_SHIFT_S s wrong from CLOCK_AFTER_S s after its start on. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>

int clock_gettime(clockid_t clock, struct timespec *now) {
    static int (*true_time)(clockid_t, struct timespec *);
    static struct timespec began;
    static long shift, after;
    if (!true_time) {
        int (*found)(clockid_t, struct timespec *) = dlsym(RTLD_NEXT, "clock_gettime");
        const char *s = getenv("CLOCK_SHIFT_S"), *a = getenv("CLOCK_AFTER_S");
        shift = s ? atol(s) : 0;
        after = a ? atol(a) : 0;
        found(CLOCK_MONOTONIC, &began);
        true_time = found;
    }
    int code = true_time(clock, now);
    if (code == 0 && clock == CLOCK_REALTIME) {
        struct timespec up;
        true_time(CLOCK_MONOTONIC, &up);
        if (up.tv_sec - began.tv_sec >= after) now->tv_sec += shift;
    }
    return code;
}

int gettimeofday(struct timeval *now, void *zone) {
    struct timespec fine;
    clock_gettime(CLOCK_REALTIME, &fine);
    now->tv_sec = fine.tv_sec;
    now->tv_usec = fine.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *now) {
    struct timespec fine;
    clock_gettime(CLOCK_REALTIME, &fine);
    if (now) *now = fine.tv_sec;
    return fine.tv_sec;
}
