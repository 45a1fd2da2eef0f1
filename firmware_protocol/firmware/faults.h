/* Detects faults from the inputs, debounces and latches them. */
#ifndef DISCO_FAULTS_H
#define DISCO_FAULTS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "robot_config.h"
#include "wheel_limits.h"

enum { DISCO_FAULT_SLOTS = 23 };

typedef enum {
    DISCO_RESET_POWER_ON = 0,
    DISCO_RESET_WATCHDOG = 1,
    DISCO_RESET_BROWN_OUT = 2
} disco_reset_cause_t;

/* What the board measures; one element of a pair is the left wheel's, then the right one's. */
typedef struct {
    uint32_t ticks[2];      /* cumulative, wrapping */
    float wheel_speed[2];   /* rad/s */
    float current[2];       /* A */
    float temperature[2];   /* degC */
    bool encoder_valid[2];
    float voltage;          /* V */
    float battery_current;  /* A */
    float battery_temperature; /* degC */
    uint16_t tx_error_count; /* over 255: bus-off */
    uint16_t rx_error_count;
    bool estop_button;
    bool estop_line;
    bool self_test_failed;
    uint8_t reset_cause;    /* disco_reset_cause_t */
} disco_inputs_t;

/* What else the detectors need to know. */
typedef struct {
    disco_wheels_t setpoint;
    bool driver_enabled;
    bool config_invalid;
    bool entropy_invalid;
    bool clock_mismatch;
    bool hash_mismatch;
    bool major_mismatch;
} disco_fault_context_t;

typedef struct {
    uint32_t present;  /* the cause is there now, not yet debounced */
    uint32_t active;   /* debounced, or held */
    uint32_t latched;
    bool started;
    uint32_t last_ticks[2];
    float opposed_speed[2];
    uint32_t opposed_since_us[2]; /* these are the low bits of times, and wrap after 71 minutes */
    uint32_t last_step_us;
    uint32_t since_us[DISCO_FAULT_SLOTS];
    uint32_t last_seen_us[DISCO_FAULT_SLOTS];
} disco_faults_t;

void disco_faults_init(disco_faults_t *faults);

/* Call once a cycle. */
void disco_faults_step(disco_faults_t *faults, const disco_config_t *config, const disco_inputs_t *inputs,
                       const disco_fault_context_t *context, uint64_t time_us);

/* Forgets the latched faults whose cause is gone, except permanent ones. */
void disco_faults_reset(disco_faults_t *faults);

/* The code to show: permanent before latched before passing ones, then in the order of the codes; 0 if none. */
uint16_t disco_faults_code(const disco_faults_t *faults);

#endif
