/* The core's own time, and its second clock, the count of its cycles. */
#ifndef DISCO_TIMEBASE_H
#define DISCO_TIMEBASE_H

#include "core.h"

void disco_time_advance(disco_firmware_t *core, uint64_t clock_us);
/* From one time to a later one, or the most that fits. */
uint32_t disco_elapsed_us(uint64_t now_us, uint64_t since_us);
void disco_time_step(disco_firmware_t *core, uint64_t clock_us);

#endif
