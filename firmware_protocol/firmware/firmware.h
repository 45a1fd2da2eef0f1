/* The reference firmware core: frames and measurements in, wheel setpoints and frames out. No I/O, clock or allocation.
 *
 * Call disco_firmware_receive for each frame from the bus and disco_firmware_step once in `cycle_us` of the
 * configuration, both with the same monotonic microsecond clock, from one context; then send what disco_firmware_pop
 * gives. The count of cycles is the core's second clock: a command is too old as soon as it is so by either, and the
 * robot stops (CLOCK_MISMATCH) when the two have come 20 ms apart, of which a tenth of a cycle is forgotten in each
 * cycle. Where the clock stands, goes back, lags behind so far, or stamps a frame over 10 ms ahead of the cycle that
 * follows, each cycle counts as long as it should be: no watchdog waits for a broken clock.
 */
#ifndef DISCO_FIRMWARE_H
#define DISCO_FIRMWARE_H

#include <stdbool.h>
#include <stdint.h>

#include "core.h"
#include "pose.h"

typedef struct {
    float left_setpoint;  /* rad/s, after all limits; 0 while the driver is off */
    float right_setpoint; /* rad/s */
    bool driver_enabled;
    bool brake;
    bool limited;         /* the setpoint is not (yet) what was asked for */
    uint8_t state;
    uint8_t session;
    uint8_t estop_source;
    uint8_t stop_cause;
    uint8_t blockers;
    uint8_t last_command_counter;
    uint16_t fault;
    uint32_t accepted_commands;
    uint32_t rejected_frames;
    uint32_t watchdog_events;
    uint32_t queued_frames;
} disco_outputs_t;

/* `entropy` seeds the challenges and nonces, and must be another one at each start: take it from a hardware generator, or
 * count the starts in flash. `last_entropy` is that of the start before, as far as the board remembers it (memory that a
 * reset leaves alone, flash); 0 if it does not. A start whose entropy is 0 or the last one is refused
 * (ENTROPY_INVALID): what was recorded before it could be replayed.
 */
void disco_firmware_init(disco_firmware_t *core, const disco_config_t *config, uint64_t entropy, uint64_t last_entropy);

void disco_firmware_receive(disco_firmware_t *core, uint64_t now_us, uint32_t can_id, const uint8_t *data,
                            uint8_t length);

void disco_firmware_step(disco_firmware_t *core, uint64_t now_us, const disco_inputs_t *inputs,
                         disco_outputs_t *outputs);

/* Queues one measured pose, true at `sample_us`; one that does not fit its frames is sent as not valid. */
void disco_firmware_pose(disco_firmware_t *core, const disco_pose_t *pose, uint64_t sample_us);

bool disco_firmware_pop(disco_firmware_t *core, disco_frame_t *frame);

#endif
