/* Conditions and transitions of the state machine. */
#ifndef DISCO_SUPERVISOR_H
#define DISCO_SUPERVISOR_H

#include "core.h"

void disco_estop_latch(disco_firmware_t *core, uint8_t source);
uint8_t disco_blockers(const disco_firmware_t *core);
void disco_supervise(disco_firmware_t *core);

#endif
