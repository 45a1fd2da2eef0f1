/* What the wheels do in each state. */
#ifndef DISCO_DRIVE_H
#define DISCO_DRIVE_H

#include "core.h"

void disco_drive_step(disco_firmware_t *core);
bool disco_wheels_still(const disco_firmware_t *core);

#endif
