/* Parameters that the host reads and writes. */
#ifndef DISCO_PARAMETERS_H
#define DISCO_PARAMETERS_H

#include "core.h"

void disco_parameter_request(disco_firmware_t *core, const uint8_t *data);

#endif
