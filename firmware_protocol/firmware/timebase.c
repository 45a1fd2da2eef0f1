#include "timebase.h"

#define FRAME_AHEAD_US (10000u)
/* How far the clock and the count of cycles may come apart, of which a tenth of a cycle is forgotten in each cycle. */
#define TOLERANCE_US (20000)
#define MOST_APART_US (2 * TOLERANCE_US)
#define FORGOTTEN_PART (10)

static int32_t limited(int32_t value, int32_t limit)
{
    const int32_t not_above = (value < limit) ? value : limit;
    return (not_above > -limit) ? not_above : -limit;
}

/* How much later than `before_us`, within MOST_APART_US. */
static int32_t apart(uint64_t clock_us, uint64_t before_us)
{
    int32_t result = -MOST_APART_US;
    if (clock_us >= before_us) {
        const uint64_t later_us = clock_us - before_us;
        result = (later_us < (uint64_t)MOST_APART_US) ? (int32_t)later_us : MOST_APART_US;
    } else if ((before_us - clock_us) < (uint64_t)MOST_APART_US) {
        result = -(int32_t)(before_us - clock_us);
    } else {
        /* far earlier */
    }
    return result;
}

static void compare(disco_firmware_t *core, uint64_t clock_us)
{
    const int32_t cycle_us = (int32_t)core->config.cycle_us;
    const int32_t ahead_us = core->clock_ahead_us + apart(clock_us, core->cycle_clock_us) - cycle_us;
    const int32_t forgotten_us = limited(ahead_us, cycle_us / FORGOTTEN_PART);
    core->clock_ahead_us = limited(ahead_us - forgotten_us, MOST_APART_US);
    core->clock_mismatch = limited(core->clock_ahead_us, TOLERANCE_US) != core->clock_ahead_us;
}

uint32_t disco_elapsed_us(uint64_t now_us, uint64_t since_us)
{
    const uint64_t elapsed_us = now_us - since_us;
    return (elapsed_us < UINT32_MAX) ? (uint32_t)elapsed_us : UINT32_MAX;
}

void disco_time_advance(disco_firmware_t *core, uint64_t clock_us)
{
    if (clock_us > core->clock_us) {
        core->now_us += clock_us - core->clock_us;
        core->clock_us = clock_us;
    }
}

void disco_time_step(disco_firmware_t *core, uint64_t clock_us)
{
    /* A frame may be stamped a little later than the cycle that follows it, but not so that time would stand long. */
    const bool back = (clock_us < core->cycle_clock_us) || (core->clock_us > (clock_us + FRAME_AHEAD_US));
    if (back) {
        core->clock_errors++;
    }
    if (core->inputs_known) {
        compare(core, clock_us);
    }
    const bool slow = core->clock_mismatch && ((clock_us - core->cycle_clock_us) < core->config.cycle_us);
    if (back || slow || (clock_us == core->cycle_clock_us)) {
        core->clock_us = clock_us;
        core->now_us += core->config.cycle_us;
    } else {
        disco_time_advance(core, clock_us);
    }
    core->cycle_clock_us = clock_us;
    core->cycles_us += core->config.cycle_us;
}
