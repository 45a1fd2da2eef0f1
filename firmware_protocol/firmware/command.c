#include "command.h"

#include "disco_robot.h"
#include "protocol_constants.h"
#include "rejection.h"
#include "timebase.h"

#define LENGTH (8u)
#define ZEROS_TO_ARM (5u)
#define VALID_FOR_UNIT_US (2000u)
#define LEFT_UNIT (1.0f / (float)DISCO_WHEEL_COMMAND_LEFT_SPEED_PER_UNIT)   /* rad/s */
#define RIGHT_UNIT (1.0f / (float)DISCO_WHEEL_COMMAND_RIGHT_SPEED_PER_UNIT) /* rad/s */

static bool asks_for_motion(const struct disco_robot_wheel_command_t *frame)
{
    return (frame->left_speed != 0) || (frame->right_speed != 0);
}

static uint8_t judge(const disco_firmware_t *core, const struct disco_robot_wheel_command_t *frame)
{
    const bool armed = core->state == DISCO_STATE_ARMED;
    const bool disarmed = (core->state == DISCO_STATE_STANDBY) || (core->state == DISCO_STATE_READY);
    uint8_t reason = DISCO_REJECT_REASON_NONE;
    if ((frame->mode > DISCO_MODE_COAST) || ((frame->mode != DISCO_MODE_SPEED) && asks_for_motion(frame))) {
        reason = DISCO_REJECT_REASON_MODE;
    } else if (frame->valid_for == 0u) {
        reason = DISCO_REJECT_REASON_VALIDITY;
    } else if (disarmed && asks_for_motion(frame)) {
        reason = DISCO_REJECT_REASON_NONZERO_BEFORE_ARMED;
    } else if (!armed && (core->state != DISCO_STATE_READY)) {
        reason = DISCO_REJECT_REASON_STATE;
    } else if (frame->session != core->session.current) {
        reason = DISCO_REJECT_REASON_SESSION;
    } else {
        /* accepted */
    }
    return reason;
}

void disco_command_receive(disco_firmware_t *core, const uint8_t *data, bool crc_ok)
{
    struct disco_robot_wheel_command_t frame;
    disco_command_t *command = &core->command;
    (void)disco_robot_wheel_command_unpack(&frame, data, LENGTH);
    const disco_e2e_status_t status = disco_e2e_check(&command->e2e, frame.counter, crc_ok, core->now_us);
    if (crc_ok && asks_for_motion(&frame)) {
        command->last_motion_us = core->now_us;
    }
    if (!disco_e2e_usable(core, status, command->e2e.qualified)) {
        command->zero_count = 0u;
        return;
    }
    const uint8_t reason = judge(core, &frame);
    if (reason != DISCO_REJECT_REASON_NONE) {
        command->zero_count = 0u;
        disco_reject(core, reason);
        return;
    }
    const uint32_t valid_for_us = (uint32_t)frame.valid_for * VALID_FOR_UNIT_US;
    const uint32_t longest_us = core->config.command_timeout_us;
    command->valid_for_us = (valid_for_us < longest_us) ? valid_for_us : longest_us;
    command->last_accepted_us = core->now_us;
    command->last_accepted_cycles_us = core->cycles_us;
    command->mode = frame.mode;
    command->counter = frame.counter;
    command->target = (disco_wheels_t){(float)frame.left_speed * LEFT_UNIT, (float)frame.right_speed * RIGHT_UNIT};
    command->accepted_count++;
    if (command->zero_count < ZEROS_TO_ARM) {
        command->zero_count++;
    }
}

void disco_command_arm(disco_firmware_t *core)
{
    disco_command_t *command = &core->command;
    command->last_accepted_us = core->now_us;
    command->last_accepted_cycles_us = core->cycles_us;
    command->valid_for_us = core->config.command_timeout_us;
    command->mode = DISCO_MODE_HOLD_ZERO;
    command->target = (disco_wheels_t){0.0f, 0.0f};
}

void disco_command_expire(disco_firmware_t *core)
{
    disco_command_t *command = &core->command;
    (void)disco_e2e_expire(&command->e2e, core->now_us);
    if (disco_elapsed_us(core->now_us, command->last_accepted_us) > core->config.command_timeout_us) {
        command->zero_count = 0u;
    }
}

bool disco_command_enough_zeros(const disco_firmware_t *core)
{
    return core->command.zero_count >= ZEROS_TO_ARM;
}

/* By the clock, or by the cycles that have ended since. */
bool disco_command_older_than(const disco_firmware_t *core, uint32_t age_us)
{
    const disco_command_t *command = &core->command;
    return (disco_elapsed_us(core->now_us, command->last_accepted_us) >= age_us) ||
           (disco_elapsed_us(core->cycles_us, command->last_accepted_cycles_us) > age_us);
}
