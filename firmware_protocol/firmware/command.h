/* The wheel command and its watchdog. */
#ifndef DISCO_COMMAND_H
#define DISCO_COMMAND_H

#include "core.h"

void disco_command_receive(disco_firmware_t *core, const uint8_t *data, bool crc_ok);
void disco_command_arm(disco_firmware_t *core);
void disco_command_expire(disco_firmware_t *core);
bool disco_command_enough_zeros(const disco_firmware_t *core);
bool disco_command_older_than(const disco_firmware_t *core, uint32_t age_us);

#endif
