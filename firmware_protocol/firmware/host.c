#include "host.h"

#include "disco_robot.h"
#include "protocol_constants.h"
#include "rejection.h"
#include "timebase.h"

#define LENGTH (8u)
#define MIXING_STEP UINT64_C(0x9E3779B97F4A7C15)

void disco_host_hello(disco_firmware_t *core, const uint8_t *data)
{
    struct disco_robot_hello_request_t hello;
    disco_host_t *host = &core->host;
    (void)disco_robot_hello_request_unpack(&hello, data, LENGTH);
    host->major_mismatch = hello.protocol_major != core->config.protocol_major;
    host->hash_mismatch = !host->major_mismatch && (hello.dbc_hash != core->config.dbc_hash);
    host->accepted = !host->major_mismatch && !host->hash_mismatch;
    host->hello_requested = true;
    host->last_frame_us = core->now_us;
    if (!host->accepted) {
        disco_reject(core, DISCO_REJECT_REASON_HANDSHAKE);
    }
}

static void judge_answer(disco_firmware_t *core, uint16_t answer)
{
    disco_session_t *session = &core->session;
    if ((core->state != DISCO_STATE_READY) || (core->host.session != session->current)) {
        return;
    }
    session->challenge_answered =
        answer == disco_challenge_answer(session->challenge, session->current, core->config.dbc_hash);
    if (!session->challenge_answered) {
        disco_reject(core, DISCO_REJECT_REASON_CHALLENGE);
    }
}

/* A reset counts from the moment it is first asked for, so that one still being asked for undoes no later stop. */
static void judge_reset(disco_firmware_t *core, uint8_t previous_request)
{
    disco_host_t *host = &core->host;
    const bool latched = (core->state == DISCO_STATE_FAULT) || (core->state == DISCO_STATE_ESTOP);
    if (host->request != DISCO_REQUEST_RESET) {
        host->reset_pending = false;
    } else if ((previous_request != DISCO_REQUEST_RESET) && latched) {
        host->reset_pending = true;
    } else {
        /* still asked for */
    }
}

void disco_host_state(disco_firmware_t *core, const uint8_t *data, bool crc_ok)
{
    struct disco_robot_host_state_t state;
    disco_host_t *host = &core->host;
    (void)disco_robot_host_state_unpack(&state, data, LENGTH);
    const disco_e2e_status_t status = disco_e2e_check(&host->e2e, state.counter, crc_ok, core->now_us);
    if (!disco_e2e_usable(core, status, host->e2e.qualified)) {
        return;
    }
    if (state.request > DISCO_REQUEST_RESET) {
        disco_reject(core, DISCO_REJECT_REASON_MODE);
        return;
    }
    const uint8_t previous_request = host->request;
    host->last_state_us = core->now_us;
    host->request = state.request;
    host->session = state.session;
    host->fault = state.host_fault;
    judge_reset(core, previous_request);
    if (state.request == DISCO_REQUEST_ARM) {
        judge_answer(core, state.challenge_answer);
    }
}

void disco_host_expire(disco_firmware_t *core)
{
    disco_host_t *host = &core->host;
    const disco_config_t *config = &core->config;
    (void)disco_e2e_expire(&host->e2e, core->now_us);
    if (disco_elapsed_us(core->now_us, host->last_state_us) > config->host_state_timeout_us) {
        host->reset_pending = false;
    }
    if (disco_elapsed_us(core->now_us, host->last_frame_us) > config->host_forget_timeout_us) {
        host->accepted = false;
        host->hash_mismatch = false;
        host->major_mismatch = false;
    }
}

/* SplitMix64 (Steele, Lea, Flood: Fast splittable pseudorandom number generators, OOPSLA 2014): unlike starts, counted
 * ones too, give unlike challenges. The last shift leaves the bits that are used as they are. */
static uint64_t mixed(uint64_t value)
{
    const uint64_t once = (value ^ (value >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
    return (once ^ (once >> 27)) * UINT64_C(0x94D049BB133111EB);
}

void disco_session_new_challenge(disco_firmware_t *core)
{
    disco_session_t *session = &core->session;
    uint16_t challenge = session->challenge;
    while ((challenge == session->challenge) || (challenge == 0u)) {
        session->entries++;
        challenge = (uint16_t)(mixed(session->entropy + (session->entries * MIXING_STEP)) >> 48);
    }
    session->challenge = challenge;
    session->challenge_answered = false;
}

void disco_session_open(disco_firmware_t *core)
{
    core->session.current = core->host.session;
    core->session.last = core->host.session;
}

void disco_session_close(disco_firmware_t *core)
{
    core->session.current = 0u;
}
