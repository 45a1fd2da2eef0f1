/* The contract on this computer without a clock or a line, for the tests: what comes is in the files LINK and PLANT,
 * BYTE_US apart, what goes out is written to standard output, and time passes as bytes are taken and the main loop
 * waits. Ends after the line does, with counts of cycles and of stores on standard error; and as a hardware watchdog
 * would, 50 ms after it was fed last. */
#include "port.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#define WATCHDOG_US (50000u)
#define WAIT_US (100u)
#define BYTE_COST_US (2u)
#define LAST_US (2000000u) /* behind the end of the line */

static FILE *link_line, *plant_line;
static uint32_t byte_us, taken, now_us, fed_us, ended_us, cycles, stores;

static void watch(void)
{
    if ((now_us - fed_us) > WATCHDOG_US) {
        (void)fprintf(stderr, "watchdog after %u cycles\n", cycles);
        exit(3);
    }
}

disco_reset_cause_t port_start(disco_config_t *config)
{
    link_line = fopen(getenv("LINK"), "rb");
    plant_line = fopen(getenv("PLANT"), "rb");
    byte_us = (uint32_t)atoi(getenv("BYTE_US"));
    config->board_id = 7u;
    return DISCO_RESET_POWER_ON;
}

uint32_t port_now_us(void)
{
    now_us++;
    return now_us;
}

/* What has come since: all the line brought in that time, and a queue that loses nothing. Each byte costs the core time. */
static size_t get(uint8_t *bytes, size_t most)
{
    const uint32_t there = (now_us / byte_us) - taken;
    const size_t count = fread(bytes, 1u, (there < most) ? there : most, link_line);
    taken = (feof(link_line) != 0) ? (now_us / byte_us) : (taken + (uint32_t)count);
    ended_us = (count > 0u) ? now_us : ended_us;
    now_us += BYTE_COST_US * (uint32_t)count;
    watch();
    return count;
}

#if defined(DISCO_LINK_CAN)
/* Identifier, length as the bus has it (up to 15), eight bytes. */
bool port_receive(disco_frame_t *frame)
{
    static uint8_t record[11];
    static size_t count;
    count += get(&record[count], sizeof(record) - count);
    const bool came = count == sizeof(record);
    if (came) {
        count = 0u;
        frame->can_id = (uint16_t)((record[0] | ((uint32_t)record[1] << 8)) & 0x7FFu);
        frame->length = record[2] & 15u;
        for (uint8_t i = 0u; i < 8u; i++) {
            frame->data[i] = record[3u + i];
        }
    }
    return came;
}

bool port_send(const disco_frame_t *frame)
{
    const uint8_t head[3] = {(uint8_t)frame->can_id, (uint8_t)(frame->can_id >> 8), frame->length};
    return (fwrite(head, 1u, sizeof(head), stdout) == sizeof(head)) &&
           (fwrite(frame->data, 1u, sizeof(frame->data), stdout) == sizeof(frame->data));
}
#else
size_t port_receive(uint8_t *bytes, size_t most)
{
    return get(bytes, most);
}

size_t port_send(const uint8_t *bytes, size_t count)
{
    /* Some at a time, so that frames wait half sent. */
    const size_t room = 1u + (now_us % 16u);
    return fwrite(bytes, 1u, (count < room) ? count : room, stdout);
}
#endif

#if defined(DISCO_PLANT_LINE)
size_t port_plant_receive(uint8_t *bytes, size_t most)
{
    return fread(bytes, 1u, most, plant_line);
}

size_t port_plant_send(const uint8_t *bytes, size_t count)
{
    (void)bytes;
    return (now_us % 3u == 0u) ? 0u : count;
}
#endif

uint64_t port_entropy(uint64_t *last)
{
    *last = 0u;
    return 1u;
}

/* Weak: that of another port takes its place where both are linked. */
__attribute__((weak)) void port_measure(port_measurement_t *measurement)
{
    measurement->inputs.encoder_valid[0] = true;
    measurement->inputs.encoder_valid[1] = true;
}

void port_drive(const disco_outputs_t *outputs)
{
    if (!(fabsf(outputs->left_setpoint) <= 8.0f) || !(fabsf(outputs->right_setpoint) <= 8.0f)) {
        (void)fprintf(stderr, "setpoints out of bounds\n");
        exit(4);
    }
}

void port_feed_watchdog(void)
{
    cycles++;
    fed_us = now_us;
    if ((now_us - ended_us) > LAST_US) {
        (void)fprintf(stderr, "%u cycles %u stores\n", cycles, stores);
        exit(0);
    }
}

bool port_load(uint8_t *record)
{
    (void)record;
    return false;
}

void port_store(const uint8_t *record)
{
    (void)record;
    stores++;
}

void port_wait(void)
{
    now_us += WAIT_US;
    watch();
}
