#include "slcan.h"

#include <string.h>

#define OK ((uint8_t)'\r')
#define ID_DIGITS (3u)
#define HEADER (1u + ID_DIGITS + 1u)
#define MAX_DATA (8u)
#define MAX_CAN_ID (0x7FFu)
#define NO_DIGIT (0xFFu)

static uint8_t digit(uint8_t value)
{
    return (uint8_t)((value < 10u) ? ((uint32_t)'0' + value) : (((uint32_t)'A' + value) - 10u));
}

static uint8_t value_of(uint8_t letter)
{
    uint8_t value = NO_DIGIT;
    if ((letter >= (uint8_t)'0') && (letter <= (uint8_t)'9')) {
        value = (uint8_t)(letter - (uint8_t)'0');
    } else if ((letter >= (uint8_t)'A') && (letter <= (uint8_t)'F')) {
        value = (uint8_t)((letter - (uint8_t)'A') + 10u);
    } else if ((letter >= (uint8_t)'a') && (letter <= (uint8_t)'f')) {
        value = (uint8_t)((letter - (uint8_t)'a') + 10u);
    } else {
        /* no hexadecimal digit */
    }
    return value;
}

void disco_slcan_init(disco_slcan_t *line)
{
    *line = (disco_slcan_t){.channel = DISCO_SLCAN_CLOSED};
}

uint8_t disco_slcan_encode(const disco_slcan_t *line, const disco_frame_t *frame, uint8_t *bytes)
{
    uint8_t at = 0u;
    if (line->channel != DISCO_SLCAN_CLOSED) {
        bytes[at++] = (uint8_t)'t';
        bytes[at++] = digit((uint8_t)(frame->can_id >> 8));
        bytes[at++] = digit((uint8_t)((frame->can_id >> 4) & 0x0Fu));
        bytes[at++] = digit((uint8_t)(frame->can_id & 0x0Fu));
        bytes[at++] = digit(frame->length);
        for (uint8_t i = 0u; i < frame->length; i++) {
            bytes[at++] = digit((uint8_t)(frame->data[i] >> 4));
            bytes[at++] = digit((uint8_t)(frame->data[i] & 0x0Fu));
        }
        bytes[at++] = OK;
    }
    return at;
}

static bool hexadecimal(const uint8_t *letters, uint8_t count)
{
    bool all = true;
    for (uint8_t i = 0u; i < count; i++) {
        all = all && (value_of(letters[i]) != NO_DIGIT);
    }
    return all;
}

/* The text of a data frame of 11 bits: t, three digits of identifier, one of length, two for each byte. */
static bool parse(const uint8_t *text, uint8_t count, disco_frame_t *frame)
{
    if ((count < HEADER) || !hexadecimal(&text[1], (uint8_t)(count - 1u))) {
        return false;
    }
    const uint32_t can_id = ((uint32_t)value_of(text[1]) << 8) | ((uint32_t)value_of(text[2]) << 4) | value_of(text[3]);
    const uint8_t length = value_of(text[4]);
    if ((can_id > MAX_CAN_ID) || (length > MAX_DATA) || (count != (HEADER + (2u * length)))) {
        return false;
    }
    frame->can_id = (uint16_t)can_id;
    frame->length = length;
    for (uint8_t i = 0u; i < length; i++) {
        const uint8_t *pair = &text[HEADER + (2u * i)];
        frame->data[i] = (uint8_t)(((uint32_t)value_of(pair[0]) << 4) | value_of(pair[1]));
    }
    return true;
}

static void answer(disco_slcan_t *line, const char *text)
{
    const size_t length = strlen(text);
    if (length <= (sizeof(line->reply) - line->replies)) {
        (void)memcpy(&line->reply[line->replies], text, length);
        line->replies = (uint8_t)(line->replies + length);
    }
}

static bool obey(disco_slcan_t *line, disco_frame_t *frame)
{
    bool found = false;
    bool refused = false;
    switch (line->pending[0]) {
    case (uint8_t)'t':
        found = (line->channel == DISCO_SLCAN_OPEN) && parse(line->pending, line->count, frame);
        refused = !found;
        break;
    case (uint8_t)'T':
    case (uint8_t)'r':
    case (uint8_t)'R':
        /* Extended and remote frames would be sent, but nobody behind this adapter listens to them. */
        refused = line->channel != DISCO_SLCAN_OPEN;
        break;
    case (uint8_t)'O':
        line->channel = DISCO_SLCAN_OPEN;
        break;
    case (uint8_t)'L':
        line->channel = DISCO_SLCAN_LISTENING;
        break;
    case (uint8_t)'C':
        line->channel = DISCO_SLCAN_CLOSED;
        break;
    case (uint8_t)'S':
    case (uint8_t)'s':
        /* There is no bus, so every bit rate will do. */
        break;
    case (uint8_t)'V':
        answer(line, "V1013");
        break;
    case (uint8_t)'N':
        answer(line, "NDISC");
        break;
    case (uint8_t)'F':
        answer(line, "F00");
        break;
    default:
        refused = true;
        break;
    }
    if (refused) {
        line->errors++;
    } else if (found) {
        line->frames++;
    } else {
        /* obeyed */
    }
    answer(line, refused ? "\a" : "\r");
    return found;
}

bool disco_slcan_feed(disco_slcan_t *line, uint8_t byte, disco_frame_t *frame)
{
    bool found = false;
    if (byte != OK) {
        if (line->count < (uint8_t)DISCO_SLCAN_LONGEST) {
            line->pending[line->count] = byte;
            line->count++;
        }
    } else {
        if (line->count == (uint8_t)DISCO_SLCAN_LONGEST) {
            line->errors++;
            answer(line, "\a");
        } else if (line->count > 0u) {
            found = obey(line, frame);
        } else {
            /* an empty line clears the way */
        }
        line->count = 0u;
    }
    return found;
}

uint8_t disco_slcan_reply(disco_slcan_t *line, uint8_t *bytes)
{
    const uint8_t count = line->replies;
    (void)memcpy(bytes, line->reply, count);
    line->replies = 0u;
    return count;
}
