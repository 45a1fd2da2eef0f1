#include "transmit.h"

#include <string.h>

#include "e2e.h"

#define LENGTH (8u)

void disco_transmit_init(disco_transmit_t *queue)
{
    *queue = (disco_transmit_t){.count = 0u};
}

uint8_t disco_transmit_counter(disco_transmit_t *queue, uint8_t message)
{
    const uint8_t counter = queue->counters[message];
    queue->counters[message] = (uint8_t)((counter + 1u) & 0x0Fu);
    return counter;
}

void disco_transmit_send(disco_transmit_t *queue, uint16_t can_id, const uint8_t *data, uint16_t data_id)
{
    if (queue->count == (uint8_t)DISCO_QUEUE_LENGTH) {
        queue->overflow_count++;
        return;
    }
    disco_frame_t *frame = &queue->frames[(queue->first + queue->count) % (uint32_t)DISCO_QUEUE_LENGTH];
    frame->can_id = can_id;
    frame->length = LENGTH;
    (void)memcpy(frame->data, data, LENGTH);
    frame->data[0] = disco_e2e_crc(frame->data, data_id);
    queue->count++;
}

bool disco_transmit_pop(disco_transmit_t *queue, disco_frame_t *frame)
{
    if (queue->count == 0u) {
        return false;
    }
    *frame = queue->frames[queue->first];
    queue->first = (uint8_t)((queue->first + 1u) % (uint32_t)DISCO_QUEUE_LENGTH);
    queue->count--;
    return true;
}
