#include "drive.h"

#include <math.h>

#include "command.h"
#include "protocol_constants.h"
#include "timebase.h"

static const disco_wheels_t standstill = {0.0f, 0.0f};

static disco_wheels_t measured(const disco_firmware_t *core)
{
    return (disco_wheels_t){core->inputs.wheel_speed[0], core->inputs.wheel_speed[1]};
}

bool disco_wheels_still(const disco_firmware_t *core)
{
    return core->inputs_known && (disco_largest(measured(core)) < core->config.still_speed);
}

static void off(disco_drive_t *drive, bool brake)
{
    drive->enabled = false;
    drive->brake = brake;
    drive->setpoint = standstill;
}

static void follow(disco_firmware_t *core, disco_wheels_t target, float max_change)
{
    disco_drive_t *drive = &core->drive;
    drive->enabled = true;
    drive->brake = false;
    /* Between two points within the limit; clamped again because nothing beyond it may ever leave this file. */
    drive->setpoint =
        disco_clamp_speed(disco_approach(drive->setpoint, target, max_change), core->config.max_wheel_speed);
}

/* What a limit of acceleration (rad/s^2) allows in a cycle, which counts as long as it should be: neither a pause nor a
 * broken clock becomes one big step. */
static float in_a_cycle(const disco_firmware_t *core, float acceleration)
{
    return acceleration * ((float)core->config.cycle_us * 1.0e-6f);
}

static void stop_and_brake(disco_firmware_t *core)
{
    disco_drive_t *drive = &core->drive;
    const bool stopped = disco_wheels_equal(drive->setpoint, standstill) && (drive->brake || disco_wheels_still(core));
    if (stopped) {
        off(drive, true);
    } else {
        follow(core, standstill, in_a_cycle(core, core->config.stop_deceleration));
    }
}

static void obey_command(disco_firmware_t *core)
{
    disco_drive_t *drive = &core->drive;
    const disco_config_t *config = &core->config;
    const disco_wheels_t target = disco_clamp_speed(core->command.target, config->max_wheel_speed);
    switch (core->command.mode) {
    case DISCO_MODE_BRAKE:
        stop_and_brake(core);
        break;
    case DISCO_MODE_COAST:
        off(drive, false);
        /* So that the driver takes over a rolling wheel without a jerk. */
        drive->setpoint = disco_clamp_speed(measured(core), config->max_wheel_speed);
        break;
    case DISCO_MODE_SPEED:
    case DISCO_MODE_HOLD_ZERO:
    default:
        follow(core, target, in_a_cycle(core, config->max_wheel_acceleration));
        break;
    }
    drive->limited = drive->enabled && !disco_wheels_equal(drive->setpoint, core->command.target);
}

/* A controlled stop ends when it is done, or when it has taken too long, or when the loop cannot be trusted. Only what
 * is driven decelerates: wheels that were released (COAST) are braked at once, as the host may have released them
 * because their encoders, which the speed loop needs, cannot be trusted. */
static bool may_decelerate(const disco_firmware_t *core)
{
    const bool in_stop = (core->state == DISCO_STATE_STOPPING) || (core->state == DISCO_STATE_ESTOP);
    const uint32_t since_stop_us = disco_elapsed_us(core->now_us, core->drive.stop_since_us);
    const bool done = disco_wheels_equal(core->drive.setpoint, standstill) && disco_wheels_still(core);
    return in_stop && core->drive.enabled && !done && (core->faults.latched == 0u) &&
           (since_stop_us < core->config.stop_timeout_us) && !disco_command_older_than(core, core->config.drive_off_timeout_us);
}

void disco_drive_step(disco_firmware_t *core)
{
    disco_drive_t *drive = &core->drive;
    drive->limited = false;
    if (core->state == DISCO_STATE_ARMED) {
        obey_command(core);
    } else if (may_decelerate(core)) {
        drive->limited = true;
        follow(core, standstill, in_a_cycle(core, core->config.stop_deceleration));
    } else {
        off(drive, true);
    }
}
