#include "telemetry.h"

#include "disco_robot.h"
#include "protocol_constants.h"
#include "quantise.h"
#include "supervisor.h"
#include "timebase.h"

#define LENGTH (8u)
#define US_PER_MS (1000u)
#define TICKS_MASK (0x00FFFFFFu)
#define TIME_MASK (UINT64_C(0xFFFFFFFFFF))
/* However often a host asks, the answer to HELLO_REQUEST leaves room for everything else. */
#define HELLO_SPACING_US (20000u)
#define HIGH_TIME_MASK (0xFFu)
#define FIRST_LIMITS (2u)
#define LARGEST_POSITION (0x7FFFFF)
#define BEYOND_POSITION (0x800000)

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
        send_frame(core, DISCO_ROBOT_##NAME##_FRAME_ID, data_, DISCO_##NAME##_DATA_ID(1u) == DISCO_##NAME##_DATA_ID(0u)); \
    } while (false)

static void send_frame(disco_firmware_t *core, uint16_t can_id, const uint8_t *data, bool any_major)
{
    const uint8_t major = any_major ? 0u : core->config.protocol_major;
    disco_transmit_send(&core->transmit, can_id, data, DISCO_DATA_ID(can_id, major));
}

static uint16_t milliseconds(uint32_t us)
{
    const uint32_t rounded = (us + (US_PER_MS / 2u)) / US_PER_MS;
    return (uint16_t)((rounded < UINT16_MAX) ? rounded : UINT16_MAX);
}

/* The low bits of a time in larger units, as if the clock that is divided had 40 bits; in divisions of 32. */
static uint16_t time_in(uint64_t now_us, uint32_t unit_us)
{
    const uint32_t high = (uint32_t)(now_us >> 32) & HIGH_TIME_MASK;
    const uint32_t low = (uint32_t)now_us;
    const uint32_t units = UINT32_MAX / unit_us; /* in 2^32, which no unit divides */
    const uint32_t rest = 0u - (units * unit_us);
    return (uint16_t)((high * units) + (low / unit_us) + (((high * rest) + (low % unit_us)) / unit_us));
}

static uint8_t saturated(uint16_t count)
{
    return (uint8_t)((count < UINT8_MAX) ? count : UINT8_MAX);
}

static void send_wheels(disco_firmware_t *core)
{
    const disco_inputs_t *in = &core->inputs;
    struct disco_robot_wheel_speed_t speed = {
        .left_valid = (uint8_t)(in->encoder_valid[0] && disco_finite(in->wheel_speed[0])),
        .right_valid = (uint8_t)(in->encoder_valid[1] && disco_finite(in->wheel_speed[1])),
        .driver_enabled = core->drive.enabled,
        .limited = core->drive.limited,
        .left_speed = disco_raw_i16(in->wheel_speed[0], DISCO_WHEEL_SPEED_LEFT_SPEED_PER_UNIT),
        .right_speed = disco_raw_i16(in->wheel_speed[1], DISCO_WHEEL_SPEED_RIGHT_SPEED_PER_UNIT),
        .sample_time = time_in(core->now_us, DISCO_WHEEL_SPEED_SAMPLE_TIME_SCALE),
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
        .left_current = disco_raw_i16(in->current[0], DISCO_MOTOR_LEFT_CURRENT_PER_UNIT),
        .right_current = disco_raw_i16(in->current[1], DISCO_MOTOR_RIGHT_CURRENT_PER_UNIT),
        .left_temperature = disco_raw_i8(in->temperature[0]),
        .right_temperature = disco_raw_i8(in->temperature[1]),
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
        .voltage = disco_raw_u16(in->voltage, DISCO_POWER_VOLTAGE_PER_UNIT),
        .current = disco_raw_i16(in->battery_current, DISCO_POWER_CURRENT_PER_UNIT),
        .temperature = disco_raw_i8(in->battery_temperature),
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

static void send_first_limits(disco_firmware_t *core)
{
    const disco_config_t *config = &core->config;
    struct disco_robot_limits_t limits = {
        .page = 0u,
        .max_wheel_speed = disco_raw_u16(config->max_wheel_speed, DISCO_LIMITS_MAX_WHEEL_SPEED_PER_UNIT),
        .max_wheel_acceleration = disco_raw_u16(config->max_wheel_acceleration, DISCO_LIMITS_MAX_WHEEL_ACCELERATION_PER_UNIT),
        .ticks_per_rev = config->ticks_per_rev,
    };
    SEND(core, LIMITS, limits, limits);
}

static void send_second_limits(disco_firmware_t *core)
{
    const disco_config_t *config = &core->config;
    struct disco_robot_limits_t limits = {
        .page = 1u,
        .command_timeout = milliseconds(config->command_timeout_us),
        .drive_off_timeout = milliseconds(config->drive_off_timeout_us),
        .stop_deceleration = disco_raw_u16(config->stop_deceleration, DISCO_LIMITS_STOP_DECELERATION_PER_UNIT),
    };
    SEND(core, LIMITS, limits, limits);
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
    SEND(core, HELLO, hello, hello);
}

static void send_build(disco_firmware_t *core)
{
    struct disco_robot_build_t build = {.dbc_hash = core->config.dbc_hash, .board_id = core->config.board_id};
    SEND(core, BUILD, build, build);
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

static int32_t within(int32_t value, int32_t minimum, int32_t maximum)
{
    const int32_t not_above = (value < maximum) ? value : maximum;
    return (not_above > minimum) ? not_above : minimum;
}

void disco_telemetry_pose(disco_firmware_t *core, const disco_pose_t *pose, uint64_t sample_us)
{
    const uint64_t own_us = sample_us + (core->now_us - core->clock_us);
    const int32_t x = within(pose->x, -BEYOND_POSITION, LARGEST_POSITION);
    const int32_t y = within(pose->y, -BEYOND_POSITION, LARGEST_POSITION);
    const int32_t yaw = within(pose->yaw, INT16_MIN, INT16_MAX);
    /* The least of a signed range has no positive counterpart. A deviation that is cut off would have the host trust a
     * pose more than its sensor does. */
    const bool valid = pose->valid && (x == pose->x) && (x != -BEYOND_POSITION) && (y == pose->y) &&
                       (y != -BEYOND_POSITION) && (yaw == pose->yaw) && (yaw != INT16_MIN) &&
                       (pose->position_std <= UINT8_MAX) && (pose->yaw_std <= UINT8_MAX);
    struct disco_robot_pose_position_t position = {.valid = valid, .x = x, .y = y};
    struct disco_robot_pose_heading_t heading = {
        .valid = valid,
        .yaw = (int16_t)yaw,
        .sample_time = time_in(own_us, DISCO_POSE_HEADING_SAMPLE_TIME_SCALE),
        .position_std = saturated(pose->position_std),
        .yaw_std = saturated(pose->yaw_std),
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

/* Whatever is due together goes out one a cycle, so that no cycle takes much longer than the others; but the wheels',
 * which come first, in theirs. */
static void send_periodic(disco_firmware_t *core)
{
    uint8_t most = 2u;
    for (uint8_t i = 0u; (i < (uint8_t)DISCO_PERIODIC) && (most > 0u); i++) {
        uint64_t *due_us = &core->telemetry.due_us[i];
        if (core->now_us >= *due_us) {
            most--;
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

static void (*const introduction[DISCO_INTRODUCTION])(disco_firmware_t *core) = {send_hello, send_build,
                                                                                 send_first_limits, send_second_limits};

/* One part a cycle. */
static void introduce(disco_firmware_t *core)
{
    disco_telemetry_t *telemetry = &core->telemetry;
    const uint32_t since_us = disco_elapsed_us(core->now_us, telemetry->hello_us);
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
        telemetry->next_part = 0u;
    } else if (telemetry->limits_changed) {
        telemetry->limits_changed = false;
        telemetry->next_part = (telemetry->next_part < FIRST_LIMITS) ? telemetry->next_part : FIRST_LIMITS;
    } else {
        /* nothing new */
    }
    if (telemetry->next_part < (uint8_t)DISCO_INTRODUCTION) {
        introduction[telemetry->next_part](core);
        telemetry->next_part++;
    }
}

void disco_telemetry_step(disco_firmware_t *core)
{
    const uint8_t queued = core->transmit.count;
    introduce(core);
    send_changes(core);
    send_periodic(core);
    if (core->transmit.count == queued) {
        disco_authentication_prepare(&core->authentication);
    }
}
