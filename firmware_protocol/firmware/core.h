/* What the parts of the core share; not for its users. */
#ifndef DISCO_CORE_H
#define DISCO_CORE_H

#include "firmware.h"
#include "protocol_constants.h"

/* timebase.c: the core's own time, and its second clock, the count of its cycles */
void disco_time_advance(disco_firmware_t *core, uint64_t clock_us);
/* From one time to a later one, or the most that fits. */
uint32_t disco_elapsed_us(uint64_t now_us, uint64_t since_us);
void disco_time_step(disco_firmware_t *core, uint64_t clock_us);

/* reception.c */
void disco_reject(disco_firmware_t *core, uint8_t reason);
bool disco_e2e_usable(disco_firmware_t *core, disco_e2e_status_t status, bool qualified);

/* host.c: handshake, requests, sessions */
void disco_host_hello(disco_firmware_t *core, const uint8_t *data);
void disco_host_state(disco_firmware_t *core, const uint8_t *data, bool crc_ok);
void disco_host_expire(disco_firmware_t *core);
void disco_session_open(disco_firmware_t *core);
void disco_session_close(disco_firmware_t *core);
void disco_session_new_challenge(disco_firmware_t *core);

/* command.c: the wheel command and its watchdog */
void disco_command_receive(disco_firmware_t *core, const uint8_t *data, bool crc_ok);
void disco_command_arm(disco_firmware_t *core);
void disco_command_expire(disco_firmware_t *core);
bool disco_command_enough_zeros(const disco_firmware_t *core);
bool disco_command_older_than(const disco_firmware_t *core, uint32_t age_us);

/* supervisor.c: conditions and transitions */
void disco_estop_latch(disco_firmware_t *core, uint8_t source);
uint8_t disco_blockers(const disco_firmware_t *core);
void disco_supervise(disco_firmware_t *core);

/* drive.c: what the wheels do in each state */
void disco_drive_step(disco_firmware_t *core);
bool disco_wheels_still(const disco_firmware_t *core);

/* parameters.c */
void disco_parameter_request(disco_firmware_t *core, const uint8_t *data);

/* telemetry.c */
void disco_telemetry_step(disco_firmware_t *core);
void disco_telemetry_time(disco_firmware_t *core, uint8_t sequence);
void disco_telemetry_parameter(disco_firmware_t *core, uint8_t status, uint16_t key, float value);

#endif
