#include "parameters.h"

#include <math.h>
#include <string.h>

#include "disco_robot.h"
#include "parameter_record.h"
#include "protocol_constants.h"
#include "telemetry.h"

#define LENGTH (8u)
#define RECORD_FORMAT (1u)
#define RECORD_ENTRY (6u) /* key and value */
#define RECORD_SEALED (DISCO_RECORD_LENGTH - 2u)

typedef struct {
    uint16_t key;
    bool writable;
    float minimum;
    float maximum;
} parameter_t;

/* Writes last until the next start, unless the board keeps them. The limits that the host was told in the handshake need a new firmware. */
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

/* Written so that what is not a number is not. */
static bool in_range(const parameter_t *parameter, float value)
{
    return (value >= parameter->minimum) && (value <= parameter->maximum);
}

/* What a parameter may be depends on others too: a board must not keep what it refuses at its next start. */
static bool config_holds(const disco_firmware_t *core, const parameter_t *parameter, float value)
{
    disco_config_t written = core->config;
    *slot(&written, parameter->key) = value;
    return disco_config_valid(&written);
}

static uint8_t judge_write(const disco_firmware_t *core, const parameter_t *parameter, float value)
{
    uint8_t status = DISCO_STATUS_OK;
    if (!parameter->writable) {
        status = DISCO_STATUS_READ_ONLY;
    } else if (!disco_finite(value)) {
        status = DISCO_STATUS_NOT_FINITE;
    } else if (!in_range(parameter, value) || !config_holds(core, parameter, value)) {
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
                core->parameter_writes++;
                core->telemetry.limits_changed = true;
            }
        } else {
            /* read */
        }
        value = *stored;
    }
    disco_telemetry_parameter(core, status, request.key, value);
}

void disco_record_pack(const disco_config_t *config, uint8_t *record)
{
    disco_config_t copy = *config;
    uint8_t *entry = &record[1];
    (void)memset(record, 0, DISCO_RECORD_LENGTH);
    record[0] = RECORD_FORMAT;
    for (size_t i = 0u; i < (sizeof(parameters) / sizeof(parameters[0])); i++) {
        if (parameters[i].writable) {
            uint32_t bits;
            (void)memcpy(&bits, slot(&copy, parameters[i].key), sizeof(bits));
            entry[0] = (uint8_t)(parameters[i].key & 0xFFu);
            entry[1] = (uint8_t)(parameters[i].key >> 8);
            for (uint8_t byte = 0u; byte < 4u; byte++) {
                entry[2u + byte] = (uint8_t)(bits >> (8u * byte));
            }
            entry = &entry[RECORD_ENTRY];
        }
    }
    const uint16_t crc = disco_crc16(record, RECORD_SEALED);
    record[RECORD_SEALED] = (uint8_t)(crc & 0xFFu);
    record[RECORD_SEALED + 1u] = (uint8_t)(crc >> 8);
}

bool disco_record_unpack(const uint8_t *record, disco_config_t *config)
{
    const uint16_t crc = (uint16_t)(record[RECORD_SEALED] | ((uint32_t)record[RECORD_SEALED + 1u] << 8));
    disco_config_t taken = *config;
    bool sound = (disco_crc16(record, RECORD_SEALED) == crc) && (record[0] == RECORD_FORMAT);
    for (size_t at = 1u; sound && ((at + RECORD_ENTRY) <= RECORD_SEALED); at += RECORD_ENTRY) {
        const uint16_t key = (uint16_t)(record[at] | ((uint32_t)record[at + 1u] << 8));
        uint32_t bits = 0u;
        float value;
        for (uint8_t byte = 0u; byte < 4u; byte++) {
            bits |= (uint32_t)record[at + 2u + byte] << (8u * byte);
        }
        (void)memcpy(&value, &bits, sizeof(value));
        if (key != 0u) {
            const parameter_t *parameter = find(key);
            sound = (parameter != NULL) && parameter->writable && in_range(parameter, value);
            *slot(&taken, key) = value;
        }
    }
    sound = sound && disco_config_valid(&taken);
    if (sound) {
        *config = taken;
    }
    return sound;
}
