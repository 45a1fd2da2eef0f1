/* The state of the firmware core, which its modules share; users of the core include firmware.h. */
#ifndef DISCO_CORE_H
#define DISCO_CORE_H

#include <stdbool.h>
#include <stdint.h>

#include "robot_config.h"
#include "authentication.h"
#include "e2e.h"
#include "faults.h"
#include "wheel_limits.h"
#include "transmit.h"

enum { DISCO_REJECT_REASONS = 16, DISCO_PERIODIC = 7, DISCO_INTRODUCTION = 4 };

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

#endif
