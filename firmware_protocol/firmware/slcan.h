/* Frames as text for a USB-CAN board: SLCAN, the commands of Lawicel's CAN232 (manual, version 3). To the host the board
 * looks like an adapter with the robot behind it.
 */
#ifndef DISCO_SLCAN_H
#define DISCO_SLCAN_H

#include <stdbool.h>
#include <stdint.h>

#include "transmit.h"

enum {
    DISCO_SLCAN_ENCODED = 22, /* the most bytes that one frame takes, or a reply */
    DISCO_SLCAN_LONGEST = 28  /* bytes of a command from here on are dropped */
};

typedef enum { DISCO_SLCAN_CLOSED = 0, DISCO_SLCAN_LISTENING = 1, DISCO_SLCAN_OPEN = 2 } disco_slcan_channel_t;

typedef struct {
    disco_slcan_channel_t channel;
    uint32_t frames;
    uint32_t errors;
    uint8_t count;
    uint8_t replies;
    uint8_t pending[DISCO_SLCAN_LONGEST];
    uint8_t reply[DISCO_SLCAN_ENCODED];
} disco_slcan_t;

void disco_slcan_init(disco_slcan_t *line);

/* Takes in one byte; whether it completed a frame for the robot, which is in `frame` then. */
bool disco_slcan_feed(disco_slcan_t *line, uint8_t byte, disco_frame_t *frame);

/* Moves what is to be answered to `bytes`; returns how many. Room for DISCO_SLCAN_ENCODED. */
uint8_t disco_slcan_reply(disco_slcan_t *line, uint8_t *bytes);

/* Writes one frame of the robot's to `bytes`; returns how many it took: none while the host has the channel closed. */
uint8_t disco_slcan_encode(const disco_slcan_t *line, const disco_frame_t *frame, uint8_t *bytes);

#endif
