#include "robot_config.h"

#include <stddef.h>

#include "protocol_constants.h"

disco_config_t disco_config_default(uint16_t ticks_per_rev, float max_wheel_speed)
{
    return (disco_config_t){
        .protocol_major = DISCO_PROTOCOL_MAJOR,
        .capabilities = DISCO_CAPABILITIES_POSE | DISCO_CAPABILITIES_MOTOR_CURRENT |
                        DISCO_CAPABILITIES_MOTOR_TEMPERATURE | DISCO_CAPABILITIES_POWER | DISCO_CAPABILITIES_BRAKE |
                        DISCO_CAPABILITIES_ESTOP_BUTTON,
        .firmware_version = {0u, 1u, 0u},
        .board_id = 1u,
        .dbc_hash = DISCO_DBC_HASH,
        .ticks_per_rev = ticks_per_rev,
        .max_wheel_speed = max_wheel_speed,
        .max_wheel_acceleration = 20.0f,
        .stop_deceleration = 20.0f,
        .still_speed = 0.05f,
        .cycle_us = 1000u,
        .command_timeout_us = 100000u,
        .drive_off_timeout_us = 500000u,
        .stop_timeout_us = 1000000u,
        .host_state_timeout_us = 500000u,
        .host_forget_timeout_us = 5000000u,
        .reset_quiet_us = 500000u,
        .under_voltage = 20.0f,
        .over_voltage = 30.0f,
        .over_current = 30.0f,
        .over_temperature = 80.0f,
        .stall_current = 15.0f,
        .encoder_check_current = 0.5f,
        .encoder_check_speed = 1.0f,
        .voltage_debounce_us = 200000u,
        .current_debounce_us = 100000u,
        .temperature_debounce_us = 1000000u,
        .encoder_debounce_us = 300000u,
        .fault_hold_us = 500000u,
    };
}

typedef struct {
    float value;
    float minimum;
    float maximum;
} bounded_t;

static bool within(const bounded_t *checks, size_t count)
{
    bool valid = true;
    for (size_t i = 0u; i < count; i++) {
        /* Written so that NaN fails. */
        valid = valid && (checks[i].value >= checks[i].minimum) && (checks[i].value <= checks[i].maximum);
    }
    return valid;
}

bool disco_config_valid(const disco_config_t *config)
{
    const bounded_t quantities[] = {
        {(float)config->ticks_per_rev, 1.0f, 65535.0f},
        {config->max_wheel_speed, 0.001f, 65.5f},
        {config->max_wheel_acceleration, 0.001f, 655.0f},
        {config->stop_deceleration, 1.0f, 655.0f},
        {config->still_speed, 0.001f, 0.5f},
        {config->under_voltage, 0.0f, 100.0f},
        {config->over_voltage, config->under_voltage, 100.0f},
        {config->over_current, 0.1f, 300.0f},
        {config->over_temperature, 20.0f, 127.0f},
        {config->stall_current, 0.1f, 300.0f},
        {config->encoder_check_current, 0.01f, 300.0f},
        {config->encoder_check_speed, 0.01f, 65.5f},
    };
    const bounded_t times_us[] = {
        {(float)config->cycle_us, 1.0e3f, 10.0e3f},
        {(float)config->command_timeout_us, 10.0e3f, 500.0e3f},
        {(float)config->drive_off_timeout_us, (float)config->command_timeout_us, 2.0e6f},
        {(float)config->stop_timeout_us, 100.0e3f, 5.0e6f},
        {(float)config->host_state_timeout_us, 100.0e3f, 2.0e6f},
        {(float)config->host_forget_timeout_us, (float)config->host_state_timeout_us, 60.0e6f},
        {(float)config->reset_quiet_us, 100.0e3f, 5.0e6f},
        {(float)config->voltage_debounce_us, 0.0f, 5.0e6f},
        {(float)config->current_debounce_us, 0.0f, 1.0e6f},
        {(float)config->temperature_debounce_us, 0.0f, 5.0e6f},
        {(float)config->encoder_debounce_us, 1.0e3f, 1.0e6f},
        {(float)config->fault_hold_us, 0.0f, 10.0e6f},
    };
    return within(quantities, sizeof(quantities) / sizeof(quantities[0])) &&
           within(times_us, sizeof(times_us) / sizeof(times_us[0]));
}
