/* The parameters that a host may write, as a board keeps them over a restart: each with its key, sealed with a CRC-16. */
#ifndef DISCO_PARAMETER_RECORD_H
#define DISCO_PARAMETER_RECORD_H

#include <stdbool.h>
#include <stdint.h>

#include "robot_config.h"

enum { DISCO_RECORD_LENGTH = 32 }; /* bytes: what flash is written in divides it */

void disco_record_pack(const disco_config_t *config, uint8_t *record);

/* Takes over all values of the record, or none if it is damaged, of another format or a value is out of its bounds. */
bool disco_record_unpack(const uint8_t *record, disco_config_t *config);

#endif
