/* The contract on this computer, for the tests: LINK and PLANT in the environment are the descriptors of its lines.
 * With the main loop and the core it is a whole board, in a process. */
#include "port.h"

#include <errno.h>
#include <poll.h>
#include <stdlib.h>
#include <sys/random.h>
#include <time.h>
#include <unistd.h>

#define CYCLE_US (1000u)

static int link_line, plant_line;
static uint32_t fed_us;
static bool held_up;
static disco_outputs_t driven;

/* A process is held up longer than the core lets a clock leap: it makes up for that, as ports/mps2 does. */
uint32_t port_now_us(void)
{
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    const uint32_t read_us = (uint32_t)((uint64_t)now.tv_sec * 1000000u) + (uint32_t)(now.tv_nsec / 1000);
    held_up = (read_us - fed_us) > CYCLE_US;
    return held_up ? (fed_us + CYCLE_US) : read_us;
}

disco_reset_cause_t port_start(disco_config_t *config)
{
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    fed_us = (uint32_t)((uint64_t)now.tv_sec * 1000000u) + (uint32_t)(now.tv_nsec / 1000);
    link_line = atoi(getenv("LINK"));
    plant_line = atoi(getenv("PLANT"));
    config->board_id = 7u;
    /* As long as may be: a host of the tests that is held up for 0.1 s has not fallen silent. */
    config->command_timeout_us = 500000u;
    config->drive_off_timeout_us = 2000000u;
    config->host_state_timeout_us = 2000000u;
    return DISCO_RESET_POWER_ON;
}

static size_t get(int line, uint8_t *bytes, size_t most)
{
    const ssize_t count = read(line, bytes, most);
    if ((count < 0) && (errno != EAGAIN)) {
        exit(0); /* whoever held the other end has gone */
    }
    return (count > 0) ? (size_t)count : 0u;
}

static size_t put(int line, const uint8_t *bytes, size_t count)
{
    const ssize_t sent = write(line, bytes, count);
    return (sent > 0) ? (size_t)sent : 0u;
}

size_t port_receive(uint8_t *bytes, size_t most)
{
    return held_up ? 0u : get(link_line, bytes, most);
}

size_t port_send(const uint8_t *bytes, size_t count)
{
    return put(link_line, bytes, count);
}

uint64_t port_entropy(uint64_t *last)
{
    uint64_t entropy = 0u;
    *last = 0u;
    (void)getrandom(&entropy, sizeof(entropy), 0u);
    return entropy;
}

/* Wheels that follow at once, and drive nowhere. Weak: those of another port take their place where both are linked. */
__attribute__((weak)) void port_measure(port_measurement_t *measurement)
{
    static float angle[2];
    const float speed[2] = {driven.left_setpoint, driven.right_setpoint};
    for (int side = 0; side < 2; side++) {
        angle[side] += speed[side] * (0.001f * 2048.0f / 6.2831853f);
        measurement->inputs.ticks[side] = (uint32_t)(int32_t)angle[side];
        measurement->inputs.wheel_speed[side] = speed[side];
        measurement->inputs.temperature[side] = 25.0f;
        measurement->inputs.encoder_valid[side] = true;
    }
}

__attribute__((weak)) void port_drive(const disco_outputs_t *outputs)
{
    driven = *outputs;
}

#if defined(DISCO_PLANT_LINE)
size_t port_plant_receive(uint8_t *bytes, size_t most)
{
    return get(plant_line, bytes, most);
}

size_t port_plant_send(const uint8_t *bytes, size_t count)
{
    return put(plant_line, bytes, count);
}
#endif

void port_feed_watchdog(void)
{
    fed_us = port_now_us();
}

bool port_load(uint8_t *record)
{
    (void)record;
    return false;
}

void port_store(const uint8_t *record)
{
    (void)record;
}

void port_wait(void)
{
    struct pollfd link = {.fd = link_line, .events = POLLIN};
    (void)poll(&link, 1u, 1);
}
