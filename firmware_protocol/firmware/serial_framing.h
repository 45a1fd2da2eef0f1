/* Frames on a serial line, between zero bytes: COBS(kind, id, data, CRC-16) 0x00, as ../README.md says.
 * COBS: Cheshire and Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Transactions on Networking 7(2), 1999.
 */
#ifndef DISCO_SERIAL_FRAMING_H
#define DISCO_SERIAL_FRAMING_H

#include <stdbool.h>
#include <stdint.h>

#include "transmit.h"

enum {
    DISCO_SERIAL_LONGEST = 64, /* bytes between delimiters from here on are dropped */
    DISCO_SERIAL_ENCODED = 15  /* the most bytes that one frame takes, its delimiter included */
};

/* Finds frames in a byte stream; after garbage it is in step again at the next delimiter. */
typedef struct {
    uint32_t frames;
    uint32_t stuffing_errors;
    uint32_t crc_errors;
    uint32_t length_errors;
    uint32_t unknown_kind;
    uint8_t count;
    uint8_t pending[DISCO_SERIAL_LONGEST];
} disco_serial_decoder_t;

/* Writes one frame to `line`, which has room for DISCO_SERIAL_ENCODED bytes; returns how many it took. */
uint8_t disco_serial_encode(const disco_frame_t *frame, uint8_t *line);

void disco_serial_init(disco_serial_decoder_t *decoder);

/* Takes in one byte; whether it completed a frame, which is in `frame` then. */
bool disco_serial_feed(disco_serial_decoder_t *decoder, uint8_t byte, disco_frame_t *frame);

#endif
