/* What the core sends: periodic frames, changes, answers. */
#ifndef DISCO_TELEMETRY_H
#define DISCO_TELEMETRY_H

#include "core.h"
#include "pose.h"

void disco_telemetry_step(disco_firmware_t *core);
void disco_telemetry_time(disco_firmware_t *core, uint8_t sequence);
void disco_telemetry_parameter(disco_firmware_t *core, uint8_t status, uint16_t key, float value);
/* Queues one measured pose, true at `sample_us` of the caller's clock. */
void disco_telemetry_pose(disco_firmware_t *core, const disco_pose_t *pose, uint64_t sample_us);

#endif
