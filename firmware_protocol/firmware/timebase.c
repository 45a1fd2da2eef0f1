#include "core.h"

#define FRAME_AHEAD_US (10000u)
/* How far the clock and the count of cycles may come apart, of which a tenth of a cycle is forgotten in each cycle. */
#define TOLERANCE_US (20000)
#define MOST_APART_US (2 * TOLERANCE_US)
#define FORGOTTEN_PART (10u)

static int64_t limited(int64_t value, int64_t limit)
{
    const int64_t not_above = (value < limit) ? value : limit;
    return (not_above > -limit) ? not_above : -limit;
}

static void compare(disco_firmware_t *core, uint64_t clock_us)
{
    const int64_t cycle_us = (int64_t)core->config.cycle_us;
    const int64_t by_clock_us = limited((int64_t)(clock_us - core->cycle_clock_us), MOST_APART_US);
    const int64_t ahead_us = core->clock_ahead_us + by_clock_us - cycle_us;
    const int64_t forgotten_us = limited(ahead_us, (int64_t)(core->config.cycle_us / FORGOTTEN_PART));
    core->clock_ahead_us = limited(ahead_us - forgotten_us, MOST_APART_US);
    core->clock_mismatch = limited(core->clock_ahead_us, TOLERANCE_US) != core->clock_ahead_us;
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
