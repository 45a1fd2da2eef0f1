#include "supervisor.h"

#include "command.h"
#include "drive.h"
#include "host.h"
#include "protocol_constants.h"
#include "states.h"
#include "timebase.h"

void disco_estop_latch(disco_firmware_t *core, uint8_t source)
{
    if (core->estop_source == DISCO_ESTOP_SOURCE_NONE) {
        core->estop_source = source;
    }
    /* Whoever asked for a reset before this stop did not know of it. */
    core->host.reset_pending = false;
}

static uint32_t when(bool holds, disco_condition_t condition)
{
    return holds ? (uint32_t)condition : 0u;
}

static bool host_silent(const disco_firmware_t *core)
{
    return disco_elapsed_us(core->now_us, core->host.last_state_us) > core->config.host_state_timeout_us;
}

static bool session_fresh(const disco_firmware_t *core)
{
    return (core->host.session != 0u) && (core->host.session != core->session.last);
}

static bool estop_input(const disco_firmware_t *core)
{
    return core->inputs.estop_button || core->inputs.estop_line;
}

static uint32_t host_conditions(const disco_firmware_t *core)
{
    const disco_host_t *host = &core->host;
    const bool stop = (host->request == DISCO_REQUEST_STANDBY) || (host->request == DISCO_REQUEST_RESET);
    return when(host->accepted, DISCO_WHEN_HOST_ACCEPTED) | when(host->e2e.qualified, DISCO_WHEN_HOST_QUALIFIED) |
           when(host_silent(core), DISCO_WHEN_HOST_SILENT) |
           when(!host->e2e.qualified && !host_silent(core), DISCO_WHEN_HOST_DISQUALIFIED) |
           when(host->fault != 0u, DISCO_WHEN_HOST_FAULT) | when(stop, DISCO_WHEN_REQUEST_STOP) |
           when(host->request == DISCO_REQUEST_READY, DISCO_WHEN_REQUEST_READY) |
           when(host->request == DISCO_REQUEST_ARM, DISCO_WHEN_REQUEST_ARM) |
           when(host->reset_pending, DISCO_WHEN_RESET) | when(session_fresh(core), DISCO_WHEN_SESSION_FRESH) |
           when(host->session != core->session.current, DISCO_WHEN_SESSION_CHANGED) |
           when(core->session.challenge_answered, DISCO_WHEN_CHALLENGE_ANSWERED);
}

static uint32_t command_conditions(const disco_firmware_t *core)
{
    const disco_command_t *command = &core->command;
    const uint32_t timeout_us = core->config.command_timeout_us;
    const bool expired =
        (command->valid_for_us < timeout_us) && disco_command_older_than(core, command->valid_for_us);
    return when(disco_command_enough_zeros(core), DISCO_WHEN_ZERO_COMMANDS) |
           when(!command->e2e.qualified, DISCO_WHEN_COMMANDS_DISQUALIFIED) |
           when(disco_command_older_than(core, timeout_us), DISCO_WHEN_COMMAND_TIMEOUT) | when(expired, DISCO_WHEN_COMMAND_EXPIRED) |
           when(disco_elapsed_us(core->now_us, command->last_motion_us) >= core->config.reset_quiet_us, DISCO_WHEN_NO_MOTION_ASKED);
}

static uint32_t conditions(const disco_firmware_t *core)
{
    const bool still = disco_wheels_still(core);
    const disco_wheels_t standstill = {0.0f, 0.0f};
    const bool stopped = still && disco_wheels_equal(core->drive.setpoint, standstill);
    const bool stop_timeout = disco_elapsed_us(core->now_us, core->drive.stop_since_us) >= core->config.stop_timeout_us;
    return host_conditions(core) | command_conditions(core) |
           when(core->self_test_passed, DISCO_WHEN_SELF_TEST_PASSED) | when(still, DISCO_WHEN_WHEELS_STILL) |
           when(stopped, DISCO_WHEN_STOPPED) | when(stop_timeout, DISCO_WHEN_STOP_TIMEOUT) |
           when((core->faults.active | core->faults.latched) != 0u, DISCO_WHEN_FAULT) |
           when(core->faults.latched != 0u, DISCO_WHEN_FAULT_LATCHED) |
           when(core->estop_source != DISCO_ESTOP_SOURCE_NONE, DISCO_WHEN_ESTOP_LATCHED) |
           when(estop_input(core), DISCO_WHEN_ESTOP_INPUT);
}

static void leave(disco_firmware_t *core, const disco_transition_t *row)
{
    if (core->state == DISCO_STATE_ARMED) {
        core->stop_cause = row->stop_cause;
        core->drive.stop_since_us = core->now_us;
        if ((row->stop_cause == DISCO_STOP_CAUSE_COMMAND_TIMEOUT) ||
            (row->stop_cause == DISCO_STOP_CAUSE_COMMAND_EXPIRED)) {
            core->watchdog_events++;
        }
    }
    if (core->state == DISCO_STATE_ESTOP) {
        core->estop_source = DISCO_ESTOP_SOURCE_NONE;
    }
    if (row->to != DISCO_STATE_ARMED) {
        disco_session_close(core);
    }
}

static void enter(disco_firmware_t *core, uint8_t state)
{
    switch (state) {
    case DISCO_STATE_STANDBY:
        core->host.reset_pending = false;
        disco_session_new_challenge(core);
        disco_authentication_renew(&core->authentication);
        break;
    case DISCO_STATE_READY:
        disco_session_open(core);
        disco_session_new_challenge(core);
        core->command.zero_count = 0u;
        break;
    case DISCO_STATE_ARMED:
        core->stop_cause = DISCO_STOP_CAUSE_NONE;
        disco_command_arm(core);
        break;
    default:
        break;
    }
    core->state = state;
}

void disco_supervise(disco_firmware_t *core)
{
    if (core->host.reset_pending) {
        disco_faults_reset(&core->faults);
    }
    const disco_transition_t *row = disco_next_transition(core->state, conditions(core));
    if (row != NULL) {
        leave(core, row);
        enter(core, row->to);
    }
}

uint8_t disco_blockers(const disco_firmware_t *core)
{
    const uint32_t now = conditions(core);
    uint32_t blockers = 0u;
    if (core->state != DISCO_STATE_ARMED) {
        const uint32_t estop = DISCO_WHEN_ESTOP_LATCHED | DISCO_WHEN_ESTOP_INPUT;
        const bool host_unfit = ((now & DISCO_WHEN_HOST_QUALIFIED) == 0u) || ((now & DISCO_WHEN_HOST_FAULT) != 0u);
        blockers = ((now & DISCO_WHEN_FAULT) != 0u) ? DISCO_BLOCKERS_FAULT : 0u;
        blockers |= ((now & estop) != 0u) ? DISCO_BLOCKERS_ESTOP : 0u;
        blockers |= ((now & DISCO_WHEN_WHEELS_STILL) == 0u) ? DISCO_BLOCKERS_WHEELS_MOVING : 0u;
        blockers |= ((now & DISCO_WHEN_HOST_ACCEPTED) == 0u) ? DISCO_BLOCKERS_HANDSHAKE : 0u;
        blockers |= host_unfit ? DISCO_BLOCKERS_HOST_STATE : 0u;
        blockers |= ((now & DISCO_WHEN_CHALLENGE_ANSWERED) == 0u) ? DISCO_BLOCKERS_CHALLENGE : 0u;
        blockers |= ((now & DISCO_WHEN_ZERO_COMMANDS) == 0u) ? DISCO_BLOCKERS_ZERO_COMMANDS : 0u;
    }
    if ((core->state != DISCO_STATE_ARMED) && (core->state != DISCO_STATE_READY)) {
        blockers |= ((now & DISCO_WHEN_SESSION_FRESH) == 0u) ? DISCO_BLOCKERS_SESSION : 0u;
    }
    return (uint8_t)blockers;
}
