/* The bounded queue of frames to send; it fills in the end-to-end header. */
#ifndef DISCO_TRANSMIT_H
#define DISCO_TRANSMIT_H

#include <stdbool.h>
#include <stdint.h>

enum { DISCO_QUEUE_LENGTH = 48, DISCO_COUNTERS = 16 };

typedef struct {
    uint16_t can_id;
    uint8_t length;
    uint8_t data[8];
} disco_frame_t;

typedef struct {
    uint8_t first;
    uint8_t count;
    uint8_t counters[DISCO_COUNTERS]; /* the next counter of each message, by the caller's index */
    uint32_t overflow_count;
    disco_frame_t frames[DISCO_QUEUE_LENGTH];
} disco_transmit_t;

void disco_transmit_init(disco_transmit_t *queue);

/* The counter to put into the next frame of this message; call once for each frame. */
uint8_t disco_transmit_counter(disco_transmit_t *queue, uint8_t message);

/* Fills in the CRC of an 8-byte frame and queues it; a frame that does not fit is counted and dropped. */
void disco_transmit_send(disco_transmit_t *queue, uint16_t can_id, const uint8_t *data, uint16_t data_id);

/* Takes the oldest frame; false if there is none. */
bool disco_transmit_pop(disco_transmit_t *queue, disco_frame_t *frame);

#endif
