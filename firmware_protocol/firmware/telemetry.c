#include <math.h>

#include "core.h"
#include "disco_robot.h"

#define LENGTH (8u)
#define US_PER_MS (1000u)
#define TICKS_MASK (0x00FFFFFFu)
#define TIME_MASK (UINT64_C(0xFFFFFFFFFF))
/* However often a host asks, the answer to HELLO_REQUEST leaves room for everything else. */
#define HELLO_SPACING_US (20000u)

/* One transmit counter each. */
enum {
    WHEEL_SPEED,
    WHEEL_TICKS,
    POSE_POSITION,
    POSE_HEADING,
    MOTOR,
    SYSTEM_STATE,
    POWER,
    LINK_HEALTH,
    SESSION_STATE,
    HELLO,
    BUILD,
    LIMITS,
    TIME_RESPONSE,
    PARAM_RESPONSE,
    MAC_CHALLENGE
};

/* Packs `frame`, a generated struct of the message, and queues it. */
#define SEND(core, NAME, name, frame)                                                                      \
    do {                                                                                                   \
        uint8_t data_[LENGTH];                                                                             \
        (frame).counter = disco_transmit_counter(&(core)->transmit, NAME);                                 \
        (void)disco_robot_##name##_pack(data_, &(frame), LENGTH);                                          \
        disco_transmit_send(&(core)->transmit, DISCO_ROBOT_##NAME##_FRAME_ID, data_,                       \
                            DISCO_##NAME##_DATA_ID((core)->config.protocol_major));                        \
    } while (false)

/* The raw value nearest to a physical one, within the signal's range; 0 for what is not a number. */
static int32_t raw(double value, double scale, int32_t minimum, int32_t maximum)
{
    const double rounded = floor((value / scale) + 0.5);
    int32_t result = 0;
    if (rounded <= (double)minimum) {
        result = minimum;
    } else if (rounded >= (double)maximum) {
        result = maximum;
    } else if (!isnan(rounded)) {
        result = (int32_t)rounded;
    } else {
        /* not a number */
    }
    return result;
}

static int16_t raw_i16(double value, double scale)
{
    return (int16_t)raw(value, scale, INT16_MIN, INT16_MAX);
}

static uint16_t raw_u16(double value, double scale)
{
    return (uint16_t)raw(value, scale, 0, UINT16_MAX);
}

static int8_t raw_i8(double value)
{
    return (int8_t)raw(value, 1.0, INT8_MIN, INT8_MAX);
}

static uint8_t raw_u8(double value, double scale)
{
    return (uint8_t)raw(value, scale, 0, UINT8_MAX);
}

static uint8_t saturated(uint16_t count)
{
    return (uint8_t)((count < UINT8_MAX) ? count : UINT8_MAX);
}

static void send_wheels(disco_firmware_t *core)
{
    const disco_inputs_t *in = &core->inputs;
    struct disco_robot_wheel_speed_t speed = {
        .left_valid = (uint8_t)(in->encoder_valid[0] && isfinite(in->wheel_speed[0])),
        .right_valid = (uint8_t)(in->encoder_valid[1] && isfinite(in->wheel_speed[1])),
        .driver_enabled = core->drive.enabled,
        .limited = core->drive.limited,
        .left_speed = raw_i16(in->wheel_speed[0], DISCO_WHEEL_SPEED_LEFT_SPEED_SCALE),
        .right_speed = raw_i16(in->wheel_speed[1], DISCO_WHEEL_SPEED_RIGHT_SPEED_SCALE),
        .sample_time = (uint16_t)((core->now_us & TIME_MASK) / (uint64_t)DISCO_WHEEL_SPEED_SAMPLE_TIME_SCALE),
    };
    struct disco_robot_wheel_ticks_t ticks = {
        .left_ticks = in->ticks[0] & TICKS_MASK,
        .right_ticks = in->ticks[1] & TICKS_MASK,
    };
    SEND(core, WHEEL_SPEED, wheel_speed, speed);
    SEND(core, WHEEL_TICKS, wheel_ticks, ticks);
}

static void send_motor(disco_firmware_t *core)
{
    const disco_inputs_t *in = &core->inputs;
    struct disco_robot_motor_t motor = {
        .left_current = raw_i16(in->current[0], DISCO_MOTOR_LEFT_CURRENT_SCALE),
        .right_current = raw_i16(in->current[1], DISCO_MOTOR_RIGHT_CURRENT_SCALE),
        .left_temperature = raw_i8(in->temperature[0]),
        .right_temperature = raw_i8(in->temperature[1]),
    };
    SEND(core, MOTOR, motor, motor);
}

static void send_system_state(disco_firmware_t *core)
{
    struct disco_robot_system_state_t state = {
        .state = core->state,
        .fault = disco_faults_code(&core->faults),
        .session = core->session.current,
        .estop_source = core->estop_source,
        .last_command_counter = core->command.counter,
        .rejected_count = (uint8_t)core->rejected_total,
        .reject_reason = core->reject_reason,
        .stop_cause = core->stop_cause,
    };
    SEND(core, SYSTEM_STATE, system_state, state);
}

static void send_session_state(disco_firmware_t *core)
{
    struct disco_robot_session_state_t session = {
        .challenge = core->session.challenge,
        .session = core->session.current,
        .host_accepted = core->host.accepted,
        .blockers = disco_blockers(core),
        .clock_error_count = (uint8_t)core->clock_errors,
    };
    SEND(core, SESSION_STATE, session_state, session);
}

static void send_mac_challenge(disco_firmware_t *core)
{
    disco_authentication_t *authentication = &core->authentication;
    struct disco_robot_mac_challenge_t challenge = {.nonce = 0u};
    authentication->nonce_shown = true;
    if (authentication->required) {
        for (uint8_t i = 0u; i < (uint8_t)DISCO_NONCE_LENGTH; i++) {
            challenge.nonce |= (uint64_t)authentication->nonce[i] << (8u * i);
        }
        SEND(core, MAC_CHALLENGE, mac_challenge, challenge);
    }
}

static void send_power(disco_firmware_t *core)
{
    const disco_inputs_t *in = &core->inputs;
    struct disco_robot_power_t power = {
        .voltage = raw_u16(in->voltage, DISCO_POWER_VOLTAGE_SCALE),
        .current = raw_i16(in->battery_current, DISCO_POWER_CURRENT_SCALE),
        .temperature = raw_i8(in->battery_temperature),
    };
    SEND(core, POWER, power, power);
}

static void send_link_health(disco_firmware_t *core)
{
    struct disco_robot_link_health_t health = {
        .tx_error_count = saturated(core->inputs.tx_error_count),
        .rx_error_count = saturated(core->inputs.rx_error_count),
        .bus_off_count = (uint8_t)core->bus_off_events,
        .crc_error_count = (uint8_t)core->crc_errors,
        .sequence_error_count = (uint8_t)core->sequence_errors,
        .watchdog_count = (uint8_t)core->watchdog_events,
    };
    SEND(core, LINK_HEALTH, link_health, health);
}

static void send_limits(disco_firmware_t *core)
{
    const disco_config_t *config = &core->config;
    struct disco_robot_limits_t first = {
        .page = 0u,
        .max_wheel_speed = raw_u16(config->max_wheel_speed, DISCO_LIMITS_MAX_WHEEL_SPEED_SCALE),
        .max_wheel_acceleration = raw_u16(config->max_wheel_acceleration, DISCO_LIMITS_MAX_WHEEL_ACCELERATION_SCALE),
        .ticks_per_rev = config->ticks_per_rev,
    };
    struct disco_robot_limits_t second = {
        .page = 1u,
        .command_timeout = raw_u16(config->command_timeout_us * 1.0e-6, DISCO_LIMITS_COMMAND_TIMEOUT_SCALE),
        .drive_off_timeout = raw_u16(config->drive_off_timeout_us * 1.0e-6, DISCO_LIMITS_DRIVE_OFF_TIMEOUT_SCALE),
        .stop_deceleration = raw_u16(config->stop_deceleration, DISCO_LIMITS_STOP_DECELERATION_SCALE),
    };
    SEND(core, LIMITS, limits, first);
    SEND(core, LIMITS, limits, second);
}

static void send_hello(disco_firmware_t *core)
{
    const disco_config_t *config = &core->config;
    struct disco_robot_hello_t hello = {
        .protocol_major = config->protocol_major,
        .protocol_minor = DISCO_PROTOCOL_MINOR,
        .firmware_major = config->firmware_version[0],
        .firmware_minor = config->firmware_version[1],
        .firmware_patch = config->firmware_version[2],
        .capabilities = (uint8_t)(config->capabilities | (config->authenticated ? DISCO_CAPABILITIES_AUTHENTICATION : 0u)),
    };
    struct disco_robot_build_t build = {.dbc_hash = config->dbc_hash, .board_id = config->board_id};
    SEND(core, HELLO, hello, hello);
    SEND(core, BUILD, build, build);
    send_limits(core);
}

void disco_telemetry_time(disco_firmware_t *core, uint8_t sequence)
{
    struct disco_robot_time_response_t response = {.sequence = sequence, .receive_time = core->now_us & TIME_MASK};
    SEND(core, TIME_RESPONSE, time_response, response);
}

void disco_telemetry_parameter(disco_firmware_t *core, uint8_t status, uint16_t key, float value)
{
    struct disco_robot_param_response_t response = {.status = status, .key = key, .value = value};
    SEND(core, PARAM_RESPONSE, param_response, response);
}

void disco_firmware_pose(disco_firmware_t *core, double x, double y, double yaw, uint64_t sample_us,
                         double position_std, double yaw_std)
{
    const uint64_t own_us = sample_us + (core->now_us - core->clock_us);
    const double largest_x = DISCO_POSE_POSITION_X_SCALE * 0x7FFFFF;
    const double largest_yaw = DISCO_POSE_HEADING_YAW_SCALE * INT16_MAX;
    const double largest_position_std = DISCO_POSE_HEADING_POSITION_STD_SCALE * UINT8_MAX;
    const double largest_yaw_std = DISCO_POSE_HEADING_YAW_STD_SCALE * UINT8_MAX;
    /* Written so that what is not a number is not valid. A deviation that is cut off would have the host trust a pose
     * more than its sensor does. */
    const bool valid = (fabs(x) <= largest_x) && (fabs(y) <= largest_x) && (fabs(yaw) <= largest_yaw) &&
                       (position_std >= 0.0) && (yaw_std >= 0.0) && (position_std <= largest_position_std) &&
                       (yaw_std <= largest_yaw_std);
    struct disco_robot_pose_position_t position = {
        .valid = valid,
        .x = raw(x, DISCO_POSE_POSITION_X_SCALE, -0x800000, 0x7FFFFF),
        .y = raw(y, DISCO_POSE_POSITION_Y_SCALE, -0x800000, 0x7FFFFF),
    };
    struct disco_robot_pose_heading_t heading = {
        .valid = valid,
        .yaw = raw_i16(yaw, DISCO_POSE_HEADING_YAW_SCALE),
        .sample_time = (uint16_t)((own_us & TIME_MASK) / (uint64_t)DISCO_POSE_HEADING_SAMPLE_TIME_SCALE),
        .position_std = raw_u8(position_std, DISCO_POSE_HEADING_POSITION_STD_SCALE),
        .yaw_std = raw_u8(yaw_std, DISCO_POSE_HEADING_YAW_STD_SCALE),
    };
    SEND(core, POSE_POSITION, pose_position, position);
    SEND(core, POSE_HEADING, pose_heading, heading);
}

typedef struct {
    void (*send)(disco_firmware_t *core);
    uint32_t period_us;
} periodic_t;

static const periodic_t periodic[DISCO_PERIODIC] = {
    {send_wheels, DISCO_ROBOT_WHEEL_SPEED_CYCLE_TIME_MS * US_PER_MS},
    {send_motor, DISCO_ROBOT_MOTOR_CYCLE_TIME_MS * US_PER_MS},
    {send_system_state, DISCO_ROBOT_SYSTEM_STATE_CYCLE_TIME_MS * US_PER_MS},
    {send_session_state, DISCO_ROBOT_SESSION_STATE_CYCLE_TIME_MS * US_PER_MS},
    {send_mac_challenge, DISCO_ROBOT_MAC_CHALLENGE_CYCLE_TIME_MS * US_PER_MS},
    {send_power, DISCO_ROBOT_POWER_CYCLE_TIME_MS * US_PER_MS},
    {send_link_health, DISCO_ROBOT_LINK_HEALTH_CYCLE_TIME_MS * US_PER_MS},
};

static void send_periodic(disco_firmware_t *core)
{
    for (uint8_t i = 0u; i < (uint8_t)DISCO_PERIODIC; i++) {
        uint64_t *due_us = &core->telemetry.due_us[i];
        if (core->now_us >= *due_us) {
            periodic[i].send(core);
            *due_us += periodic[i].period_us;
            if (*due_us <= core->now_us) {
                *due_us = core->now_us + periodic[i].period_us;
            }
        }
    }
}

static void send_changes(disco_firmware_t *core)
{
    disco_telemetry_t *shown = &core->telemetry;
    const uint16_t fault = disco_faults_code(&core->faults);
    if ((shown->shown_state != core->state) || (shown->shown_fault != fault) ||
        (shown->shown_session != core->session.current)) {
        send_system_state(core);
    }
    if ((shown->shown_session != core->session.current) || (shown->shown_challenge != core->session.challenge) ||
        (shown->shown_accepted != core->host.accepted)) {
        send_session_state(core);
    }
    if (!core->authentication.nonce_shown) {
        send_mac_challenge(core);
    }
    shown->shown_state = core->state;
    shown->shown_fault = fault;
    shown->shown_session = core->session.current;
    shown->shown_challenge = core->session.challenge;
    shown->shown_accepted = core->host.accepted;
}

static void introduce(disco_firmware_t *core)
{
    disco_telemetry_t *telemetry = &core->telemetry;
    const uint64_t since_us = core->now_us - telemetry->hello_us;
    const bool unknown = !core->host.accepted && (since_us >= (DISCO_ROBOT_HELLO_CYCLE_TIME_MS * US_PER_MS));
    const bool asked = core->host.hello_requested && (since_us >= HELLO_SPACING_US);
    if (!telemetry->introduced || unknown || asked) {
        telemetry->introduced = true;
        telemetry->hello_us = core->now_us;
        if (core->host.hello_requested && (core->session.current == 0u)) {
            /* A host that begins anew does not know how far the freshness counters have come. */
            disco_authentication_renew(&core->authentication);
        }
        core->host.hello_requested = false;
        telemetry->limits_changed = false;
        send_hello(core);
    } else if (telemetry->limits_changed) {
        telemetry->limits_changed = false;
        send_limits(core);
    } else {
        /* nothing new */
    }
}

void disco_telemetry_step(disco_firmware_t *core)
{
    introduce(core);
    send_changes(core);
    send_periodic(core);
}
