/* The host: handshake, requests, sessions and challenges. */
#ifndef DISCO_HOST_H
#define DISCO_HOST_H

#include "core.h"

void disco_host_hello(disco_firmware_t *core, const uint8_t *data);
void disco_host_state(disco_firmware_t *core, const uint8_t *data, bool crc_ok);
void disco_host_expire(disco_firmware_t *core);
void disco_session_open(disco_firmware_t *core);
void disco_session_close(disco_firmware_t *core);
void disco_session_new_challenge(disco_firmware_t *core);

#endif
