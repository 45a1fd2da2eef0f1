#include "firmware.h"

#include "command.h"
#include "drive.h"
#include "host.h"
#include "protocol_constants.h"
#include "supervisor.h"
#include "telemetry.h"
#include "timebase.h"

#define BUS_OFF_ABOVE (255u)

void disco_firmware_init(disco_firmware_t *core, const disco_config_t *config, uint64_t entropy, uint64_t last_entropy)
{
    *core = (disco_firmware_t){
        .config = *config,
        .state = DISCO_STATE_BOOT,
        .config_valid = disco_config_valid(config),
        .entropy_valid = (entropy != 0u) && (entropy != last_entropy),
        .session = {.entropy = entropy},
        .drive = {.brake = true},
    };
    disco_authentication_init(&core->authentication, config->authenticated, config->key, entropy);
    disco_faults_init(&core->faults);
    disco_transmit_init(&core->transmit);
    disco_e2e_init(&core->host.e2e, config->host_state_timeout_us);
    disco_e2e_init(&core->command.e2e, config->drive_off_timeout_us);
}

static void watch(disco_firmware_t *core)
{
    const disco_inputs_t *inputs = &core->inputs;
    const disco_fault_context_t context = {
        .setpoint = core->drive.setpoint,
        .driver_enabled = core->drive.enabled,
        .config_invalid = !core->config_valid,
        .entropy_invalid = !core->entropy_valid,
        .clock_mismatch = core->clock_mismatch,
        .hash_mismatch = core->host.hash_mismatch,
        .major_mismatch = core->host.major_mismatch,
    };
    disco_faults_step(&core->faults, &core->config, inputs, &context, core->now_us);
    core->self_test_passed = core->config_valid && !inputs->self_test_failed;
    const bool bus_off = inputs->tx_error_count > BUS_OFF_ABOVE;
    if (bus_off && !core->bus_off) {
        core->bus_off_events++;
    }
    core->bus_off = bus_off;
    if (inputs->estop_button) {
        disco_estop_latch(core, DISCO_ESTOP_SOURCE_BUTTON);
    }
    if (inputs->estop_line) {
        disco_estop_latch(core, DISCO_ESTOP_SOURCE_LINE);
    }
}

static void report(const disco_firmware_t *core, disco_outputs_t *outputs)
{
    const disco_drive_t *drive = &core->drive;
    *outputs = (disco_outputs_t){
        .left_setpoint = drive->enabled ? drive->setpoint.left : 0.0f,
        .right_setpoint = drive->enabled ? drive->setpoint.right : 0.0f,
        .driver_enabled = drive->enabled,
        .brake = drive->brake,
        .limited = drive->limited,
        .state = core->state,
        .session = core->session.current,
        .estop_source = core->estop_source,
        .stop_cause = core->stop_cause,
        .blockers = disco_blockers(core),
        .last_command_counter = core->command.counter,
        .fault = disco_faults_code(&core->faults),
        .accepted_commands = core->command.accepted_count,
        .rejected_frames = core->rejected_total,
        .watchdog_events = core->watchdog_events,
        .queued_frames = core->transmit.count,
    };
}

void disco_firmware_step(disco_firmware_t *core, uint64_t now_us, const disco_inputs_t *inputs,
                         disco_outputs_t *outputs)
{
    disco_time_step(core, now_us);
    core->inputs = *inputs;
    core->inputs_known = true;
    disco_host_expire(core);
    disco_command_expire(core);
    watch(core);
    disco_supervise(core);
    disco_drive_step(core);
    disco_telemetry_step(core);
    report(core, outputs);
}

bool disco_firmware_pop(disco_firmware_t *core, disco_frame_t *frame)
{
    return disco_transmit_pop(&core->transmit, frame);
}

void disco_firmware_pose(disco_firmware_t *core, const disco_pose_t *pose, uint64_t sample_us)
{
    disco_telemetry_pose(core, pose, sample_us);
}
