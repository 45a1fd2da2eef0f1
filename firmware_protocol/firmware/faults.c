#include "faults.h"

#include <math.h>

#include "protocol_constants.h"

#define LATCHING (0x0800u)
#define PERMANENT (0x0400u)
#define BUS_OFF_ABOVE (255u)
#define MISSED_TICKS (3.0f)
#define TWO_PI (6.2831853f)
/* A wheel may be turned by hand, downhill or by a step of the clock: only what no wheel can do is a jump. */
#define JUMP_SPEED_FACTOR (3.0f)
#define JUMP_TICKS_SLACK (16.0f)
/* A wheel that turns against its setpoint but slows down is only late. */
#define STILL_SLOWING_FACTOR (0.9f)

typedef enum { NO_DEBOUNCE, VOLTAGE, CURRENT, TEMPERATURE, ENCODER } debounce_t;

typedef struct {
    uint16_t code;
    debounce_t debounce;
} fault_row_t;

/* A pair's left wheel is at its index, the right one directly after it. */
enum {
    SLOT_SELF_TEST,
    SLOT_CONFIG,
    SLOT_ENTROPY,
    SLOT_WATCHDOG_RESET,
    SLOT_BROWN_OUT_RESET,
    SLOT_OVER_CURRENT,
    SLOT_STALL = SLOT_OVER_CURRENT + 2,
    SLOT_ENCODER_MISSING = SLOT_STALL + 2,
    SLOT_ENCODER_JUMP = SLOT_ENCODER_MISSING + 2,
    SLOT_WRONG_DIRECTION = SLOT_ENCODER_JUMP + 2,
    SLOT_UNDER_VOLTAGE = SLOT_WRONG_DIRECTION + 2,
    SLOT_OVER_VOLTAGE,
    SLOT_OVER_TEMPERATURE,
    SLOT_BUS_OFF = SLOT_OVER_TEMPERATURE + 2,
    SLOT_HASH_MISMATCH,
    SLOT_MAJOR_MISMATCH,
    SLOT_CLOCK_MISMATCH
};

/* In the order in which they are shown. */
static const fault_row_t rows[DISCO_FAULT_SLOTS] = {
    {DISCO_FAULT_SELF_TEST_FAILED, NO_DEBOUNCE},
    {DISCO_FAULT_CONFIG_INVALID, NO_DEBOUNCE},
    {DISCO_FAULT_ENTROPY_INVALID, NO_DEBOUNCE},
    {DISCO_FAULT_WATCHDOG_RESET, NO_DEBOUNCE},
    {DISCO_FAULT_BROWN_OUT_RESET, NO_DEBOUNCE},
    {DISCO_FAULT_OVER_CURRENT_LEFT, CURRENT},
    {DISCO_FAULT_OVER_CURRENT_RIGHT, CURRENT},
    {DISCO_FAULT_STALL_LEFT, ENCODER},
    {DISCO_FAULT_STALL_RIGHT, ENCODER},
    {DISCO_FAULT_ENCODER_MISSING_LEFT, ENCODER},
    {DISCO_FAULT_ENCODER_MISSING_RIGHT, ENCODER},
    {DISCO_FAULT_ENCODER_JUMP_LEFT, NO_DEBOUNCE},
    {DISCO_FAULT_ENCODER_JUMP_RIGHT, NO_DEBOUNCE},
    {DISCO_FAULT_WRONG_DIRECTION_LEFT, NO_DEBOUNCE},
    {DISCO_FAULT_WRONG_DIRECTION_RIGHT, NO_DEBOUNCE},
    {DISCO_FAULT_UNDER_VOLTAGE, VOLTAGE},
    {DISCO_FAULT_OVER_VOLTAGE, VOLTAGE},
    {DISCO_FAULT_OVER_TEMPERATURE_LEFT, TEMPERATURE},
    {DISCO_FAULT_OVER_TEMPERATURE_RIGHT, TEMPERATURE},
    {DISCO_FAULT_BUS_OFF, NO_DEBOUNCE},
    {DISCO_FAULT_DBC_HASH_MISMATCH, NO_DEBOUNCE},
    {DISCO_FAULT_PROTOCOL_MAJOR_MISMATCH, NO_DEBOUNCE},
    {DISCO_FAULT_CLOCK_MISMATCH, NO_DEBOUNCE},
};

void disco_faults_init(disco_faults_t *faults)
{
    *faults = (disco_faults_t){.active = 0u};
}

static uint32_t bit_if(bool present, uint32_t slot)
{
    return present ? (UINT32_C(1) << slot) : 0u;
}

static uint32_t debounce_us(const disco_config_t *config, debounce_t kind)
{
    switch (kind) {
    case VOLTAGE:
        return config->voltage_debounce_us;
    case CURRENT:
        return config->current_debounce_us;
    case TEMPERATURE:
        return config->temperature_debounce_us;
    case ENCODER: {
        /* At a few ticks a turn, a healthy wheel is without a tick for longer than any fixed time. */
        const float ticks_us =
            (MISSED_TICKS * TWO_PI * 1.0e6f) / ((float)config->ticks_per_rev * config->encoder_check_speed);
        return (uint32_t)fmaxf((float)config->encoder_debounce_us, ticks_us);
    }
    case NO_DEBOUNCE:
    default:
        return 0u;
    }
}

static bool jumped(const disco_faults_t *faults, const disco_config_t *config, uint32_t wheel, uint32_t ticks,
                   uint32_t now_us)
{
    const int32_t difference = (int32_t)(ticks - faults->last_ticks[wheel]);
    const float elapsed_s = (float)(now_us - faults->last_step_us) * 1.0e-6f;
    const float ticks_per_s = (config->max_wheel_speed * (float)config->ticks_per_rev) / TWO_PI;
    return fabsf((float)difference) > ((JUMP_SPEED_FACTOR * ticks_per_s * elapsed_s) + JUMP_TICKS_SLACK);
}

static bool wrong_direction(disco_faults_t *faults, const disco_config_t *config, uint32_t wheel, float setpoint,
                            float speed, uint32_t now_us)
{
    const float proof = config->encoder_check_speed;
    const bool opposed = ((setpoint > proof) && (speed < -proof)) || ((setpoint < -proof) && (speed > proof));
    if (!opposed) {
        faults->opposed_since_us[wheel] = now_us;
        faults->opposed_speed[wheel] = 0.0f;
        return false;
    }
    if (faults->opposed_speed[wheel] <= 0.0f) {
        faults->opposed_speed[wheel] = fabsf(speed);
    }
    if ((now_us - faults->opposed_since_us[wheel]) < config->encoder_debounce_us) {
        return false;
    }
    const bool slowing = fabsf(speed) < (STILL_SLOWING_FACTOR * faults->opposed_speed[wheel]);
    faults->opposed_since_us[wheel] = now_us;
    faults->opposed_speed[wheel] = fabsf(speed);
    return !slowing;
}

static uint32_t wheel_faults(disco_faults_t *faults, const disco_config_t *config, const disco_inputs_t *inputs,
                             const disco_fault_context_t *context, uint32_t wheel, uint32_t now_us)
{
    const float setpoint = (wheel == 0u) ? context->setpoint.left : context->setpoint.right;
    const float speed = inputs->wheel_speed[wheel];
    const float current = fabsf(inputs->current[wheel]);
    const bool moved = inputs->ticks[wheel] != faults->last_ticks[wheel];
    const bool driven = context->driver_enabled && (fabsf(setpoint) > config->encoder_check_speed);
    const bool dead = driven && !moved && (current > config->encoder_check_current);
    uint32_t present = 0u;

    /* Limits are asked for negated where a value that is not a number must count as a fault. */
    present |= bit_if(!(current <= config->over_current), SLOT_OVER_CURRENT + wheel);
    present |= bit_if(!(inputs->temperature[wheel] <= config->over_temperature), SLOT_OVER_TEMPERATURE + wheel);
    present |= bit_if(dead && (current > config->stall_current), SLOT_STALL + wheel);
    present |= bit_if((dead && (current <= config->stall_current)) || !inputs->encoder_valid[wheel] || !disco_finite(speed),
                      SLOT_ENCODER_MISSING + wheel);
    present |= bit_if(jumped(faults, config, wheel, inputs->ticks[wheel], now_us), SLOT_ENCODER_JUMP + wheel);
    present |= bit_if(wrong_direction(faults, config, wheel, context->driver_enabled ? setpoint : 0.0f, speed, now_us),
                      SLOT_WRONG_DIRECTION + wheel);
    return present;
}

static uint32_t board_faults(const disco_config_t *config, const disco_inputs_t *inputs,
                             const disco_fault_context_t *context)
{
    uint32_t present = 0u;
    present |= bit_if(inputs->self_test_failed, SLOT_SELF_TEST);
    present |= bit_if(context->config_invalid, SLOT_CONFIG);
    present |= bit_if(context->entropy_invalid, SLOT_ENTROPY);
    present |= bit_if(!(inputs->voltage >= config->under_voltage), SLOT_UNDER_VOLTAGE);
    present |= bit_if(inputs->voltage > config->over_voltage, SLOT_OVER_VOLTAGE);
    present |= bit_if(inputs->tx_error_count > BUS_OFF_ABOVE, SLOT_BUS_OFF);
    present |= bit_if(context->hash_mismatch, SLOT_HASH_MISMATCH);
    present |= bit_if(context->major_mismatch, SLOT_MAJOR_MISMATCH);
    present |= bit_if(context->clock_mismatch, SLOT_CLOCK_MISMATCH);
    return present;
}

static void settle(disco_faults_t *faults, const disco_config_t *config, uint32_t slot, uint32_t now_us)
{
    const uint32_t mask = UINT32_C(1) << slot;
    const fault_row_t *row = &rows[slot];
    if ((faults->present & mask) == 0u) {
        faults->since_us[slot] = now_us;
        if ((now_us - faults->last_seen_us[slot]) >= config->fault_hold_us) {
            faults->active &= ~mask;
        }
    } else {
        const uint32_t debounced_us = debounce_us(config, row->debounce);
        if ((now_us - faults->since_us[slot]) >= debounced_us) {
            /* However long it lasts, its time does not wrap. */
            faults->since_us[slot] = now_us - debounced_us;
            faults->last_seen_us[slot] = now_us;
            faults->active |= mask;
            faults->latched |= ((row->code & LATCHING) != 0u) ? mask : 0u;
        }
    }
}

void disco_faults_step(disco_faults_t *faults, const disco_config_t *config, const disco_inputs_t *inputs,
                       const disco_fault_context_t *context, uint64_t time_us)
{
    const uint32_t now_us = (uint32_t)time_us;
    uint32_t present = board_faults(config, inputs, context);
    if (!faults->started) {
        faults->started = true;
        faults->last_ticks[0] = inputs->ticks[0];
        faults->last_ticks[1] = inputs->ticks[1];
        faults->last_step_us = now_us;
        for (uint32_t slot = 0u; slot < (uint32_t)DISCO_FAULT_SLOTS; slot++) {
            faults->since_us[slot] = now_us;
        }
        present |= bit_if(inputs->reset_cause == (uint8_t)DISCO_RESET_WATCHDOG, SLOT_WATCHDOG_RESET);
        present |= bit_if(inputs->reset_cause == (uint8_t)DISCO_RESET_BROWN_OUT, SLOT_BROWN_OUT_RESET);
    }
    for (uint32_t wheel = 0u; wheel < 2u; wheel++) {
        present |= wheel_faults(faults, config, inputs, context, wheel, now_us);
        faults->last_ticks[wheel] = inputs->ticks[wheel];
    }
    faults->present = present;
    faults->last_step_us = now_us;
    for (uint32_t slot = 0u; slot < (uint32_t)DISCO_FAULT_SLOTS; slot++) {
        settle(faults, config, slot, now_us);
    }
}

void disco_faults_reset(disco_faults_t *faults)
{
    for (uint32_t slot = 0u; slot < (uint32_t)DISCO_FAULT_SLOTS; slot++) {
        const uint32_t mask = UINT32_C(1) << slot;
        if (((rows[slot].code & PERMANENT) == 0u) && ((faults->present & mask) == 0u)) {
            faults->latched &= ~mask;
            faults->active &= ~mask;
        }
    }
}

uint16_t disco_faults_code(const disco_faults_t *faults)
{
    const uint32_t shown = faults->active | faults->latched;
    for (uint32_t slot = 0u; slot < (uint32_t)DISCO_FAULT_SLOTS; slot++) {
        if ((shown & (UINT32_C(1) << slot)) != 0u) {
            return rows[slot].code;
        }
    }
    return DISCO_FAULT_NONE;
}
