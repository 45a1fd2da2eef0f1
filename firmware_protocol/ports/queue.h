/* A queue between one interrupt and the main loop, without a lock: one side only puts, the other only takes. Whoever puts
 * owns `put`, whoever takes owns `taken`; each tells the other by one atomic store, after the bytes themselves. On one
 * core and on two (RP2040, ESP32). */
#ifndef DISCO_QUEUE_H
#define DISCO_QUEUE_H

#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { DISCO_BYTES = 512 }; /* a power of two */

typedef struct {
    uint8_t bytes[DISCO_BYTES];
    atomic_uint put;
    atomic_uint taken;
    atomic_uint lost; /* bytes that did not fit */
} disco_queue_t;

/* Puts all of `count` bytes or, where there is no room, none. */
static inline bool disco_queue_put(disco_queue_t *queue, const uint8_t *bytes, size_t count)
{
    const unsigned put = atomic_load_explicit(&queue->put, memory_order_relaxed);
    const unsigned used = put - atomic_load_explicit(&queue->taken, memory_order_acquire);
    if (count > ((size_t)DISCO_BYTES - used)) {
        const unsigned lost = atomic_load_explicit(&queue->lost, memory_order_relaxed);
        atomic_store_explicit(&queue->lost, lost + (unsigned)count, memory_order_relaxed);
        return false;
    }
    for (size_t i = 0u; i < count; i++) {
        queue->bytes[(put + i) % (size_t)DISCO_BYTES] = bytes[i];
    }
    atomic_store_explicit(&queue->put, put + (unsigned)count, memory_order_release);
    return true;
}

/* Takes up to `most` bytes, oldest first; returns how many. */
static inline size_t disco_queue_take(disco_queue_t *queue, uint8_t *bytes, size_t most)
{
    const unsigned taken = atomic_load_explicit(&queue->taken, memory_order_relaxed);
    const unsigned there = atomic_load_explicit(&queue->put, memory_order_acquire) - taken;
    const size_t count = (most < there) ? most : there;
    for (size_t i = 0u; i < count; i++) {
        bytes[i] = queue->bytes[(taken + i) % (size_t)DISCO_BYTES];
    }
    atomic_store_explicit(&queue->taken, taken + (unsigned)count, memory_order_release);
    return count;
}

#endif
