#include "robot_config.h"

#include <stddef.h>

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
