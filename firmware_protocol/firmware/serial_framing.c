#include "serial_framing.h"

#include <string.h>

#include "e2e.h"

#define KIND_CAN_FRAME (1u)
#define HEADER (3u)
#define CRC (2u)
#define MAX_DATA (8u)
#define MAX_CAN_ID (0x7FFu)
#define BAD (0xFFu)

uint8_t disco_serial_encode(const disco_frame_t *frame, uint8_t *line)
{
    uint8_t body[HEADER + MAX_DATA + CRC] = {KIND_CAN_FRAME, (uint8_t)(frame->can_id & 0xFFu),
                                             (uint8_t)(frame->can_id >> 8)};
    const uint8_t length = (uint8_t)(HEADER + frame->length);
    uint8_t code_at = 0u;
    uint8_t at = 1u;
    (void)memcpy(&body[HEADER], frame->data, frame->length);
    const uint16_t crc = disco_crc16(body, length);
    body[length] = (uint8_t)(crc & 0xFFu);
    body[length + 1u] = (uint8_t)(crc >> 8);
    for (uint8_t i = 0u; i < (uint8_t)(length + CRC); i++) {
        if (body[i] == 0u) {
            line[code_at] = (uint8_t)(at - code_at);
            code_at = at;
        } else {
            line[at] = body[i];
        }
        at++;
    }
    line[code_at] = (uint8_t)(at - code_at);
    line[at] = 0u;
    return (uint8_t)(at + 1u);
}

void disco_serial_init(disco_serial_decoder_t *decoder)
{
    *decoder = (disco_serial_decoder_t){.count = 0u};
}

/* Takes the stuffing out, in place; returns the length, or BAD if a block says that it is longer than what came. */
static uint8_t unstuffed(uint8_t *piece, uint8_t count)
{
    uint8_t from = 0u;
    uint8_t to = 0u;
    while (from < count) {
        const uint8_t code = piece[from];
        if (code > (count - from)) {
            return BAD;
        }
        if (from > 0u) {
            piece[to] = 0u;
            to++;
        }
        for (uint8_t i = 1u; i < code; i++) {
            piece[to] = piece[from + i];
            to++;
        }
        from = (uint8_t)(from + code);
    }
    return to;
}

static bool unwrap(disco_serial_decoder_t *decoder, disco_frame_t *frame)
{
    uint8_t *body = decoder->pending;
    const uint8_t length = unstuffed(body, decoder->count);
    bool found = false;
    if (length == BAD) {
        decoder->stuffing_errors++;
    } else if (length < (HEADER + CRC)) {
        decoder->length_errors++;
    } else {
        const uint8_t sealed = (uint8_t)(length - CRC);
        const uint16_t crc = (uint16_t)(body[sealed] | ((uint32_t)body[sealed + 1u] << 8));
        const uint16_t can_id = (uint16_t)(body[1] | ((uint32_t)body[2] << 8));
        if (disco_crc16(body, sealed) != crc) {
            decoder->crc_errors++;
        } else if (body[0] != KIND_CAN_FRAME) {
            decoder->unknown_kind++;
        } else if ((can_id > MAX_CAN_ID) || (sealed > (HEADER + MAX_DATA))) {
            decoder->length_errors++;
        } else {
            decoder->frames++;
            frame->can_id = can_id;
            frame->length = (uint8_t)(sealed - HEADER);
            (void)memcpy(frame->data, &body[HEADER], frame->length);
            found = true;
        }
    }
    return found;
}

bool disco_serial_feed(disco_serial_decoder_t *decoder, uint8_t byte, disco_frame_t *frame)
{
    bool found = false;
    if (byte != 0u) {
        if (decoder->count < (uint8_t)DISCO_SERIAL_LONGEST) {
            decoder->pending[decoder->count] = byte;
            decoder->count++;
        }
    } else {
        if (decoder->count == (uint8_t)DISCO_SERIAL_LONGEST) {
            decoder->length_errors++;
        } else if (decoder->count > 0u) {
            found = unwrap(decoder, frame);
        } else {
            /* silence */
        }
        decoder->count = 0u;
    }
    return found;
}
