/* One thread puts, another takes: what is taken is what was put, in its order, none lost but what was told as lost. */
#include <pthread.h>
#include <sched.h>
#include <stdio.h>

#include "queue.h"

enum { RECORDS = 400000 };

static disco_queue_t queue;

static void *putter(void *unused)
{
    (void)unused;
    for (uint32_t number = 0u; number < (uint32_t)RECORDS; number++) {
        const uint8_t record[4] = {(uint8_t)number, (uint8_t)(number >> 8), (uint8_t)(number >> 16), 0x5Au};
        while (!disco_queue_put(&queue, record, sizeof(record))) {
            (void)sched_yield();
        }
    }
    return NULL;
}

int main(void)
{
    pthread_t thread;
    uint8_t record[4];
    uint32_t wrong = 0u;
    size_t have = 0u;
    if (pthread_create(&thread, NULL, putter, NULL) != 0) {
        return 2;
    }
    for (uint32_t number = 0u; number < (uint32_t)RECORDS;) {
        const size_t taken = disco_queue_take(&queue, &record[have], sizeof(record) - have);
        have += taken;
        if (taken == 0u) {
            (void)sched_yield();
        }
        if (have == sizeof(record)) {
            const uint32_t told = record[0] | ((uint32_t)record[1] << 8) | ((uint32_t)record[2] << 16);
            wrong += ((told != number) || (record[3] != 0x5Au)) ? 1u : 0u;
            number++;
            have = 0u;
        }
    }
    (void)pthread_join(thread, NULL);
    (void)printf("%u wrong, %u left\n", wrong, (unsigned)(queue.put - queue.taken));
    return (wrong == 0u) ? 0 : 1;
}
