/* A virtual robot in the place of wheels: what `disco-hw sim --board` says of them over a second serial line, and what they
 * shall do. Compiled with -DDISCO_PLANT_LINE alone; port_measure and port_drive are then never called. The frames are
 * those of serial_framing.h, under identifiers that the protocol does not have; sim/board.py is the other end. */
#include "port.h"

#include <string.h>

#include "serial_framing.h"

enum { WHEELS = 0x7E0, POWER = 0x7E1, POSITION = 0x7E2, HEADING = 0x7E3, SETPOINTS = 0x7E8, STATE = 0x7E9, ABOUT = 0x7EA };

#define VERSION (1u)
#define SILENT_US (100000u)
#define TOLD_PERIOD (10u) /* cycles; what changes is told at once */
#define ABOUT_PERIOD (100u)
#define ESTOP_BUTTON (1u)
#define SPEED_UNIT (1.0f / 500.0f)  /* rad/s */
#define CURRENT_UNIT (0.01f)        /* A */
#define VOLTAGE_UNIT (0.01f)        /* V */
#define AGE_UNIT_US (100u)
#define STD_UNIT (0.001f)           /* m, rad */

static disco_serial_decoder_t line;
static uint16_t counted[2];
static float position[2];
static uint32_t heard_us;
static bool heard;
static struct {
    uint8_t bytes[3u * (uint32_t)DISCO_SERIAL_ENCODED];
    uint8_t count;
    uint8_t sent;
} outgoing;

static uint16_t word(const uint8_t *data, uint8_t at)
{
    return (uint16_t)(data[at] | ((uint32_t)data[at + 1u] << 8));
}

static float number(const uint8_t *data, uint8_t at)
{
    float value;
    (void)memcpy(&value, &data[at], sizeof(value));
    return value;
}

static void take_wheels(disco_inputs_t *inputs, const uint8_t *data)
{
    for (uint8_t side = 0u; side < 2u; side++) {
        const uint16_t count = word(data, (uint8_t)(2u * side));
        /* A virtual robot that has just begun counts from another number. */
        const uint16_t turned = heard ? (uint16_t)(count - counted[side]) : 0u;
        inputs->ticks[side] += (uint32_t)(int32_t)(int16_t)turned;
        inputs->wheel_speed[side] = (float)(int16_t)word(data, (uint8_t)(4u + (2u * side))) * SPEED_UNIT;
        counted[side] = count;
    }
    heard = true;
    heard_us = port_now_us();
}

static void take_power(disco_inputs_t *inputs, const uint8_t *data)
{
    inputs->voltage = (float)word(data, 4u) * VOLTAGE_UNIT;
    inputs->battery_current = 0.0f;
    inputs->estop_button = (data[7] & ESTOP_BUTTON) != 0u;
    for (uint8_t side = 0u; side < 2u; side++) {
        inputs->current[side] = (float)(int16_t)word(data, (uint8_t)(2u * side)) * CURRENT_UNIT;
        inputs->temperature[side] = (float)(int8_t)data[6];
        inputs->battery_current += inputs->current[side];
    }
}

static void take_heading(port_measurement_t *measurement, const uint8_t *data)
{
    measurement->pose = disco_pose(position[0], position[1], number(data, 0u), (float)data[6] * STD_UNIT,
                                   (float)data[7] * STD_UNIT);
    measurement->pose_us = port_now_us() - (word(data, 4u) * AGE_UNIT_US);
    measurement->posed = true;
}

/* Whether it was a sample of the wheels. */
static bool take(port_measurement_t *measurement, const disco_frame_t *frame)
{
    if (frame->length != 8u) {
        return false;
    }
    switch (frame->can_id) {
    case WHEELS:
        take_wheels(&measurement->inputs, frame->data);
        break;
    case POWER:
        take_power(&measurement->inputs, frame->data);
        break;
    case POSITION:
        position[0] = number(frame->data, 0u);
        position[1] = number(frame->data, 4u);
        break;
    case HEADING:
        take_heading(measurement, frame->data);
        break;
    default:
        break;
    }
    return frame->can_id == (uint16_t)WHEELS;
}

void plant_line_measure(port_measurement_t *measurement)
{
    disco_frame_t frame;
    uint8_t byte;
    /* Two samples at most: what a computer was late with comes at once, and would look like an encoder that jumps. */
    uint8_t samples = 2u;
    while ((samples > 0u) && (port_plant_receive(&byte, 1u) == 1u)) {
        if (disco_serial_feed(&line, byte, &frame) && take(measurement, &frame)) {
            samples--;
        }
    }
    disco_inputs_t *inputs = &measurement->inputs;
    if (!heard || ((port_now_us() - heard_us) > SILENT_US)) {
        /* No virtual robot, no battery: UNDER_VOLTAGE stops it, and passes when the robot is there. */
        heard = false;
        inputs->voltage = 0.0f;
        for (uint8_t side = 0u; side < 2u; side++) {
            inputs->wheel_speed[side] = 0.0f;
            inputs->current[side] = 0.0f;
        }
    }
    inputs->encoder_valid[0] = true;
    inputs->encoder_valid[1] = true;
}

static void say(uint16_t can_id, const void *first, const void *second)
{
    disco_frame_t frame = {.can_id = can_id, .length = 8u};
    (void)memcpy(&frame.data[0], first, 4u);
    (void)memcpy(&frame.data[4], second, 4u);
    outgoing.count = (uint8_t)(outgoing.count + disco_serial_encode(&frame, &outgoing.bytes[outgoing.count]));
}

void plant_line_drive(const disco_outputs_t *outputs, const disco_config_t *config)
{
    static uint32_t cycles;
    static float told[2];
    static uint8_t told_state[4];
    if (outgoing.sent == outgoing.count) {
        const uint8_t state[4] = {(uint8_t)((outputs->driver_enabled ? 1u : 0u) | (outputs->brake ? 2u : 0u)),
                                  outputs->state, (uint8_t)outputs->fault, (uint8_t)(outputs->fault >> 8)};
        outgoing.sent = 0u;
        outgoing.count = 0u;
        const bool due = (cycles % TOLD_PERIOD) == 0u;
        if (due || (told[0] != outputs->left_setpoint) || (told[1] != outputs->right_setpoint)) {
            told[0] = outputs->left_setpoint;
            told[1] = outputs->right_setpoint;
            say((uint16_t)SETPOINTS, &told[0], &told[1]);
        }
        if (due || (memcmp(told_state, state, sizeof(state)) != 0)) {
            (void)memcpy(told_state, state, sizeof(state));
            say((uint16_t)STATE, state, &outputs->accepted_commands);
        }
        if ((cycles % ABOUT_PERIOD) == 0u) {
            const uint8_t about[4] = {VERSION, outputs->session, (uint8_t)config->ticks_per_rev,
                                      (uint8_t)(config->ticks_per_rev >> 8)};
            say((uint16_t)ABOUT, about, &config->max_wheel_speed);
        }
        cycles++;
    }
    outgoing.sent += (uint8_t)port_plant_send(&outgoing.bytes[outgoing.sent], (size_t)outgoing.count - outgoing.sent);
}
