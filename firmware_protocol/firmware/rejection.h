/* Counts rejected frames by reason, and decides whether a protected frame may be used. */
#ifndef DISCO_REJECTION_H
#define DISCO_REJECTION_H

#include "core.h"

void disco_reject(disco_firmware_t *core, uint8_t reason);
/* Whether a frame of this end-to-end status may be used; counts the reason if not. */
bool disco_e2e_usable(disco_firmware_t *core, disco_e2e_status_t status, bool qualified);

#endif
