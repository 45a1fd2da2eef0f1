/* A yardstick: a thread that sleeps to the end of each period and does nothing else.
 *
 *     bare_loop PERIOD_US PRIORITY [CPU LEAST_US]
 *
 * Prints how late it woke (p50, p99, p99.9 and the longest, in us, as JSON) when its standard input is closed. With a
 * processor to stay on it prints, as it happens, from when to when (CLOCK_MONOTONIC, ns) it was not run for longer than
 * LEAST_US: at the highest priority, a time in which nobody was. */
#define _GNU_SOURCE
#include <poll.h>
#include <sched.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>

enum { MOST_SAMPLES = 1 << 20 };

static int64_t late_ns[MOST_SAMPLES];

static int ascending(const void *a, const void *b)
{
    const int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
    return (x > y) - (x < y);
}

static double at_us(size_t count, double part)
{
    return (double)late_ns[(size_t)(part * (double)(count - 1))] * 1e-3;
}

int main(int count_arguments, char **arguments)
{
    if (count_arguments != 3 && count_arguments != 5) {
        fprintf(stderr, "usage: bare_loop PERIOD_US PRIORITY [CPU LEAST_US]\n");
        return 2;
    }
    const bool watches = count_arguments == 5;
    const int64_t least_ns = watches ? 1000 * atoll(arguments[4]) : 0;
    if (watches) {
        cpu_set_t only;
        CPU_ZERO(&only);
        CPU_SET(atoi(arguments[3]), &only);
        if (sched_setaffinity(0, sizeof only, &only) != 0) {
            perror("bare_loop: CPU");
            return 1;
        }
    }
    const int64_t period_ns = 1000 * atoll(arguments[1]);
    const struct sched_param priority = {.sched_priority = atoi(arguments[2])};
    if (priority.sched_priority > 0 && sched_setscheduler(0, SCHED_FIFO, &priority) != 0) {
        perror("bare_loop: SCHED_FIFO");
        return 1;
    }
    mlockall(MCL_CURRENT | MCL_FUTURE);
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    int64_t due_ns = (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
    size_t count = 0;
    struct pollfd input = {.fd = 0, .events = POLLIN};
    while (count < MOST_SAMPLES && poll(&input, 1, 0) == 0) {
        due_ns += period_ns;
        const struct timespec due = {.tv_sec = due_ns / 1000000000, .tv_nsec = due_ns % 1000000000};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
        clock_gettime(CLOCK_MONOTONIC, &now);
        late_ns[count] = (int64_t)now.tv_sec * 1000000000 + now.tv_nsec - due_ns;
        if (watches && late_ns[count] > least_ns) {
            printf("%lld %lld\n", (long long)due_ns, (long long)(due_ns + late_ns[count]));
            fflush(stdout);
        }
        if (late_ns[count] > period_ns)
            due_ns += late_ns[count] / period_ns * period_ns;
        count++;
    }
    if (watches)
        return 0;
    if (count == 0)
        return 1;
    qsort(late_ns, count, sizeof late_ns[0], ascending);
    printf("{\"p50\": %.1f, \"p99\": %.1f, \"p999\": %.1f, \"max\": %.1f, \"periods\": %zu}\n", at_us(count, 0.5),
           at_us(count, 0.99), at_us(count, 0.999), at_us(count, 1.0), count);
    return 0;
}
