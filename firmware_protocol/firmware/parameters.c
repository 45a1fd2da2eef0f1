#include <math.h>

#include "core.h"
#include "disco_robot.h"

#define LENGTH (8u)

typedef struct {
    uint16_t key;
    bool writable;
    float minimum;
    float maximum;
} parameter_t;

/* Writes last until the next start. The limits that the host was told in the handshake need a new firmware. */
static const parameter_t parameters[] = {
    {DISCO_KEY_OVER_CURRENT, true, 0.5f, 200.0f},
    {DISCO_KEY_OVER_TEMPERATURE, true, 30.0f, 120.0f},
    {DISCO_KEY_UNDER_VOLTAGE, true, 5.0f, 60.0f},
    {DISCO_KEY_STOP_DECELERATION, true, 1.0f, 655.0f},
    {.key = DISCO_KEY_MAX_WHEEL_SPEED, .writable = false},
    {.key = DISCO_KEY_MAX_WHEEL_ACCELERATION, .writable = false},
};

static float *slot(disco_config_t *config, uint16_t key)
{
    float *value;
    switch (key) {
    case DISCO_KEY_OVER_CURRENT:
        value = &config->over_current;
        break;
    case DISCO_KEY_OVER_TEMPERATURE:
        value = &config->over_temperature;
        break;
    case DISCO_KEY_UNDER_VOLTAGE:
        value = &config->under_voltage;
        break;
    case DISCO_KEY_STOP_DECELERATION:
        value = &config->stop_deceleration;
        break;
    case DISCO_KEY_MAX_WHEEL_SPEED:
        value = &config->max_wheel_speed;
        break;
    case DISCO_KEY_MAX_WHEEL_ACCELERATION:
    default:
        value = &config->max_wheel_acceleration;
        break;
    }
    return value;
}

static bool disarmed(const disco_firmware_t *core)
{
    return (core->state == DISCO_STATE_STANDBY) || (core->state == DISCO_STATE_FAULT) ||
           (core->state == DISCO_STATE_ESTOP && !core->drive.enabled);
}

static uint8_t judge_write(const disco_firmware_t *core, const parameter_t *parameter, float value)
{
    uint8_t status = DISCO_STATUS_OK;
    if (!parameter->writable) {
        status = DISCO_STATUS_READ_ONLY;
    } else if (!isfinite(value)) {
        status = DISCO_STATUS_NOT_FINITE;
    } else if ((value < parameter->minimum) || (value > parameter->maximum)) {
        status = DISCO_STATUS_OUT_OF_RANGE;
    } else if (!disarmed(core)) {
        status = DISCO_STATUS_REFUSED_ARMED;
    } else {
        /* accepted */
    }
    return status;
}

static const parameter_t *find(uint16_t key)
{
    for (size_t i = 0u; i < (sizeof(parameters) / sizeof(parameters[0])); i++) {
        if (parameters[i].key == key) {
            return &parameters[i];
        }
    }
    return NULL;
}

void disco_parameter_request(disco_firmware_t *core, const uint8_t *data)
{
    struct disco_robot_param_request_t request;
    (void)disco_robot_param_request_unpack(&request, data, LENGTH);
    const parameter_t *parameter = find(request.key);
    float value = 0.0f;
    uint8_t status = DISCO_STATUS_UNKNOWN_KEY;
    if (parameter != NULL) {
        float *stored = slot(&core->config, request.key);
        status = DISCO_STATUS_OK;
        if (request.operation > DISCO_OPERATION_WRITE) {
            status = DISCO_STATUS_UNKNOWN_OPERATION;
        } else if (request.operation == DISCO_OPERATION_WRITE) {
            status = judge_write(core, parameter, request.value);
            if (status == DISCO_STATUS_OK) {
                *stored = request.value;
                core->telemetry.limits_changed = true;
            }
        } else {
            /* read */
        }
        value = *stored;
    }
    disco_telemetry_parameter(core, status, request.key, value);
}
