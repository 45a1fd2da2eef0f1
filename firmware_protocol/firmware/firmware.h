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

#include "robot_config.h"
#include "authentication.h"
#include "e2e.h"
#include "faults.h"
#include "wheel_limits.h"
#include "transmit.h"

enum { DISCO_REJECT_REASONS = 16, DISCO_PERIODIC = 7, DISCO_INTRODUCTION = 4 };

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

/* The other end, as far as it has proved itself. */
typedef struct {
    disco_e2e_receiver_t e2e;
    uint64_t last_state_us;
    uint64_t last_frame_us;
    uint16_t fault;
    uint8_t request;
    uint8_t session;
    bool accepted;
    bool hash_mismatch;
    bool major_mismatch;
    bool hello_requested;
    bool reset_pending;
} disco_host_t;

typedef struct {
    uint16_t challenge;
    uint64_t entropy;
    uint32_t entries; /* makes each challenge another one */
    uint8_t current;  /* 0: none */
    uint8_t last;
    bool challenge_answered;
} disco_session_t;

typedef struct {
    disco_e2e_receiver_t e2e;
    uint64_t last_accepted_us;
    uint64_t last_accepted_cycles_us; /* the same on the second clock */
    uint64_t last_motion_us; /* when motion was last asked for, accepted or not */
    uint32_t valid_for_us;
    uint32_t accepted_count;
    disco_wheels_t target;
    uint8_t mode;
    uint8_t counter;
    uint8_t zero_count;
} disco_command_t;

typedef struct {
    disco_wheels_t setpoint;
    uint64_t stop_since_us;
    bool enabled;
    bool brake;
    bool limited;
} disco_drive_t;

typedef struct {
    uint64_t due_us[DISCO_PERIODIC];
    uint64_t hello_us;
    uint16_t shown_fault;
    uint16_t shown_challenge;
    uint8_t shown_state;
    uint8_t shown_session;
    bool shown_accepted;
    uint8_t next_part; /* of the introduction */
    bool limits_changed;
    bool introduced;
} disco_telemetry_t;

/* A measured pose in the units of its frames. */
typedef struct {
    int32_t x;             /* 0.1 mm */
    int32_t y;             /* 0.1 mm */
    int32_t yaw;           /* 0.1 mrad */
    uint16_t position_std; /* mm */
    uint16_t yaw_std;      /* mrad */
    bool valid;
} disco_pose_t;

/* The same from metres and radians; not valid where a value is not finite or a deviation below zero. A float tells
 * 0.1 mm apart up to 800 m: whoever knows a pose better makes the struct himself. */
disco_pose_t disco_pose(float x, float y, float yaw, float position_std, float yaw_std);

/* What is asked for most often comes first: a Cortex-M0+ reaches only the first bytes of a struct in one instruction. */
typedef struct {
    uint8_t state;
    uint8_t estop_source;
    uint8_t stop_cause;
    uint8_t reject_reason;
    bool config_valid;
    bool self_test_passed;
    bool bus_off;
    bool inputs_known;
    bool clock_mismatch;
    bool entropy_valid;
    disco_session_t session;
    uint64_t now_us;         /* the core's own time, which only goes forwards */
    uint64_t clock_us;       /* the caller's clock, when it last told */
    uint64_t cycle_clock_us; /* the same, at the last cycle */
    uint64_t cycles_us;      /* the second clock: cycles, each as long as it should be */
    int32_t clock_ahead_us;  /* of the second clock, forgotten slowly */
    uint32_t rejected_total;
    uint32_t crc_errors;
    uint32_t sequence_errors;
    uint32_t watchdog_events;
    disco_drive_t drive;
    disco_host_t host;
    disco_command_t command;
    disco_config_t config;
    disco_inputs_t inputs;
    disco_telemetry_t telemetry;
    uint32_t bus_off_events;
    uint32_t clock_errors;
    uint32_t unknown_frames;
    uint32_t parameter_writes; /* by the host, accepted */
    uint32_t rejected[DISCO_REJECT_REASONS];
    disco_faults_t faults;
    disco_transmit_t transmit;
    disco_authentication_t authentication;
} disco_firmware_t;

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
