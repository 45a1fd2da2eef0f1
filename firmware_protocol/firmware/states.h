/* The arming state machine as a table: which conditions lead from which state to which. */
#ifndef DISCO_STATES_H
#define DISCO_STATES_H

#include <stddef.h>
#include <stdint.h>

/* One bit for each fact that the table asks about. */
typedef enum {
    DISCO_WHEN_SELF_TEST_PASSED = 1 << 0,
    DISCO_WHEN_HOST_ACCEPTED = 1 << 1,
    DISCO_WHEN_HOST_QUALIFIED = 1 << 2,
    DISCO_WHEN_HOST_SILENT = 1 << 3,
    DISCO_WHEN_HOST_DISQUALIFIED = 1 << 4,
    DISCO_WHEN_HOST_FAULT = 1 << 5,
    DISCO_WHEN_REQUEST_STOP = 1 << 6, /* STANDBY or RESET */
    DISCO_WHEN_REQUEST_READY = 1 << 7,
    DISCO_WHEN_REQUEST_ARM = 1 << 8,
    DISCO_WHEN_RESET = 1 << 9,
    DISCO_WHEN_SESSION_FRESH = 1 << 10,
    DISCO_WHEN_SESSION_CHANGED = 1 << 11,
    DISCO_WHEN_CHALLENGE_ANSWERED = 1 << 12,
    DISCO_WHEN_ZERO_COMMANDS = 1 << 13,
    DISCO_WHEN_COMMANDS_DISQUALIFIED = 1 << 14,
    DISCO_WHEN_COMMAND_TIMEOUT = 1 << 15,
    DISCO_WHEN_COMMAND_EXPIRED = 1 << 16,
    DISCO_WHEN_NO_MOTION_ASKED = 1 << 17,
    DISCO_WHEN_WHEELS_STILL = 1 << 18,
    DISCO_WHEN_STOPPED = 1 << 19,
    DISCO_WHEN_STOP_TIMEOUT = 1 << 20,
    DISCO_WHEN_FAULT = 1 << 21,
    DISCO_WHEN_FAULT_LATCHED = 1 << 22,
    DISCO_WHEN_ESTOP_LATCHED = 1 << 23,
    DISCO_WHEN_ESTOP_INPUT = 1 << 24
} disco_condition_t;

/* Leads from any state whose bit (1 << state) is in `from`; the first row that holds is taken. */
typedef struct {
    uint16_t from;
    uint8_t to;
    uint8_t stop_cause; /* recorded if the state left is ARMED */
    uint32_t needs_all;
    uint32_t needs_any; /* 0: nothing */
    uint32_t blocked_by;
} disco_transition_t;

const disco_transition_t *disco_transitions(size_t *count);

/* The row to take, or NULL to stay. */
const disco_transition_t *disco_next_transition(uint8_t state, uint32_t conditions);

#endif
