#include "command.h"
#include "disco_robot.h"
#include "firmware.h"
#include "host.h"
#include "parameters.h"
#include "protocol_constants.h"
#include "rejection.h"
#include "supervisor.h"
#include "telemetry.h"
#include "timebase.h"

#define LENGTH (8u)

static bool crc_holds(disco_firmware_t *core, const uint8_t *data, uint16_t data_id)
{
    const bool holds = disco_e2e_crc(data, data_id) == data[0];
    if (holds) {
        core->host.last_frame_us = core->now_us;
    } else {
        core->crc_errors++;
        disco_reject(core, DISCO_REJECT_REASON_CRC);
    }
    return holds;
}

static bool proved(disco_firmware_t *core, disco_proof_index_t index, uint32_t can_id, const uint8_t *data)
{
    const bool holds = disco_authentication_holds(&core->authentication, index, can_id, data);
    if (!holds) {
        disco_reject(core, DISCO_REJECT_REASON_AUTHENTICATION);
    }
    return holds;
}

static void time_request(disco_firmware_t *core, const uint8_t *data)
{
    struct disco_robot_time_request_t request;
    (void)disco_robot_time_request_unpack(&request, data, LENGTH);
    disco_telemetry_time(core, request.sequence);
}

static void dispatch(disco_firmware_t *core, uint32_t can_id, const uint8_t *data)
{
    const uint8_t major = core->config.protocol_major;
    bool sound = false;
    switch (can_id) {
    case DISCO_ROBOT_WHEEL_COMMAND_MAC_FRAME_ID:
        disco_authentication_offer(&core->authentication, DISCO_PROOF_WHEEL_COMMAND, data);
        break;
    case DISCO_ROBOT_HOST_STATE_MAC_FRAME_ID:
        disco_authentication_offer(&core->authentication, DISCO_PROOF_HOST_STATE, data);
        break;
    case DISCO_ROBOT_PARAM_REQUEST_MAC_FRAME_ID:
        disco_authentication_offer(&core->authentication, DISCO_PROOF_PARAM_REQUEST, data);
        break;
    case DISCO_ROBOT_WHEEL_COMMAND_FRAME_ID:
        sound = crc_holds(core, data, DISCO_WHEEL_COMMAND_DATA_ID(major));
        if (!sound || proved(core, DISCO_PROOF_WHEEL_COMMAND, can_id, data)) {
            disco_command_receive(core, data, sound);
        }
        break;
    case DISCO_ROBOT_HOST_STATE_FRAME_ID:
        sound = crc_holds(core, data, DISCO_HOST_STATE_DATA_ID(major));
        if (!sound || proved(core, DISCO_PROOF_HOST_STATE, can_id, data)) {
            disco_host_state(core, data, sound);
        }
        break;
    case DISCO_ROBOT_HELLO_REQUEST_FRAME_ID:
        if (crc_holds(core, data, DISCO_HELLO_REQUEST_DATA_ID(major))) {
            disco_host_hello(core, data);
        }
        break;
    case DISCO_ROBOT_TIME_REQUEST_FRAME_ID:
        if (crc_holds(core, data, DISCO_TIME_REQUEST_DATA_ID(major))) {
            time_request(core, data);
        }
        break;
    case DISCO_ROBOT_PARAM_REQUEST_FRAME_ID:
    default:
        if (crc_holds(core, data, DISCO_PARAM_REQUEST_DATA_ID(major)) &&
            proved(core, DISCO_PROOF_PARAM_REQUEST, can_id, data)) {
            disco_parameter_request(core, data);
        }
        break;
    }
}

static bool is_for_us(uint32_t can_id)
{
    return (can_id == DISCO_ROBOT_WHEEL_COMMAND_FRAME_ID) || (can_id == DISCO_ROBOT_HOST_STATE_FRAME_ID) ||
           (can_id == DISCO_ROBOT_HELLO_REQUEST_FRAME_ID) || (can_id == DISCO_ROBOT_TIME_REQUEST_FRAME_ID) ||
           (can_id == DISCO_ROBOT_PARAM_REQUEST_FRAME_ID) || (can_id == DISCO_ROBOT_WHEEL_COMMAND_MAC_FRAME_ID) ||
           (can_id == DISCO_ROBOT_HOST_STATE_MAC_FRAME_ID) || (can_id == DISCO_ROBOT_PARAM_REQUEST_MAC_FRAME_ID);
}

void disco_firmware_receive(disco_firmware_t *core, uint64_t now_us, uint32_t can_id, const uint8_t *data,
                            uint8_t length)
{
    disco_time_advance(core, now_us);
    /* A command that comes too late must find the watchdog expired, even if no cycle ran in between. */
    disco_supervise(core);
    if (can_id == DISCO_ROBOT_ESTOP_FRAME_ID) {
        disco_estop_latch(core, DISCO_ESTOP_SOURCE_FRAME);
    } else if (!is_for_us(can_id)) {
        core->unknown_frames++;
    } else if (length != LENGTH) {
        disco_reject(core, DISCO_REJECT_REASON_LENGTH);
    } else {
        dispatch(core, can_id, data);
    }
    disco_supervise(core);
}
