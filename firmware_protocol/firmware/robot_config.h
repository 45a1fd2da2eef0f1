/* What differs between robots: limits, timeouts, thresholds. Bounds are in robot_config.c; no timeout can be switched off. */
#ifndef DISCO_ROBOT_CONFIG_H
#define DISCO_ROBOT_CONFIG_H

#include <stdbool.h>
#include <stdint.h>

typedef struct {
    uint8_t protocol_major;
    uint8_t capabilities;
    uint8_t firmware_version[3];
    uint16_t board_id;
    uint32_t dbc_hash;

    uint16_t ticks_per_rev;
    float max_wheel_speed;        /* rad/s */
    float max_wheel_acceleration; /* rad/s^2 */
    float stop_deceleration;      /* rad/s^2 */
    float still_speed;            /* rad/s: slower counts as standing */

    uint32_t cycle_us;               /* the period at which disco_firmware_step is called */
    uint32_t command_timeout_us;
    uint32_t drive_off_timeout_us;
    uint32_t stop_timeout_us;
    uint32_t host_state_timeout_us;
    uint32_t host_forget_timeout_us; /* after this silence a host must introduce itself again */
    uint32_t reset_quiet_us;         /* no motion may be asked for this long before an e-stop is reset */

    float under_voltage;          /* V */
    float over_voltage;           /* V */
    float over_current;           /* A */
    float over_temperature;       /* degC */
    float stall_current;          /* A: more, without motion, is a stall */
    float encoder_check_current;  /* A: more, without ticks, is a missing encoder */
    float encoder_check_speed;    /* rad/s: a setpoint or speed below this proves nothing about the encoder */
    uint32_t voltage_debounce_us;
    uint32_t current_debounce_us;
    uint32_t temperature_debounce_us;
    uint32_t encoder_debounce_us;
    uint32_t fault_hold_us; /* a fault that clears by itself is shown at least this long */

    bool authenticated;     /* whether commands need a proof made with `key` (AES-128) */
    uint8_t key[16];
} disco_config_t;

/* The configuration of a robot of which no more is known than this; rad/s. Python's `FirmwareConfig` takes it from here. */
disco_config_t disco_config_default(uint16_t ticks_per_rev, float max_wheel_speed);

/* Whether every value is finite and within its bounds. */
bool disco_config_valid(const disco_config_t *config);

#endif
