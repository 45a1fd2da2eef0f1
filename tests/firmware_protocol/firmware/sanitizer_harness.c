/* Runs the core under the sanitizers: a host that arms and drives, a robot with mad measurements, and random frames.
 * Prints how often each state was seen; exits 1 if the core ever drives outside its limits or states. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "disco_robot.h"
#include "firmware.h"
#include "parameter_record.h"
#include "protocol_constants.h"
#include "serial_framing.h"
#include "slcan.h"

static uint64_t seed;

static uint32_t random_u32(void)
{
    seed ^= seed << 13;
    seed ^= seed >> 7;
    seed ^= seed << 17;
    return (uint32_t)(seed >> 32);
}

static bool chance(uint32_t one_in)
{
    return random_u32() % one_in == 0u;
}

static float mad_float(void)
{
    static const float special[] = {NAN, INFINITY, -INFINITY, 3.4e38f, -3.4e38f, 1.0e7f, 1.0e-45f, -0.0f};
    return special[random_u32() % (sizeof(special) / sizeof(special[0]))];
}

static void receive(disco_firmware_t *core, uint64_t now, uint32_t id, uint8_t *data, uint16_t data_id)
{
    data[0] = disco_e2e_crc(data, data_id);
    disco_firmware_receive(core, now, id, data, 8u);
}

/* Proves a frame as a host with the key does; the nonce is read where the robot would tell it. */
static void prove(disco_firmware_t *core, uint64_t now, uint32_t id, const uint8_t *frame)
{
    static uint64_t freshness[DISCO_PROOFS];
    static uint8_t nonce[DISCO_NONCE_LENGTH];
    uint8_t message[24], tag[16], proof[8];
    disco_cmac_key_t key;
    if (!core->config.authenticated) {
        return;
    }
    if (memcmp(nonce, core->authentication.nonce, sizeof(nonce)) != 0) {
        (void)memcpy(nonce, core->authentication.nonce, sizeof(nonce));
        (void)memset(freshness, 0, sizeof(freshness));
    }
    freshness[id - 0x100u]++;
    (void)memcpy(message, nonce, sizeof(nonce));
    for (uint8_t i = 0u; i < 8u; i++) {
        message[6u + i] = (uint8_t)(freshness[id - 0x100u] >> (8u * i));
    }
    message[14] = (uint8_t)id;
    message[15] = (uint8_t)(id >> 8);
    (void)memcpy(&message[16], frame, 8u);
    /* In a block of its own, so that the sanitizers see a step beyond its end. */
    uint8_t *bare_key = malloc(16u);
    (void)memcpy(bare_key, core->config.key, 16u);
    disco_cmac_init(&key, bare_key);
    free(bare_key);
    disco_cmac(&key, message, sizeof(message), tag);
    proof[0] = message[6];
    proof[1] = message[7];
    (void)memcpy(&proof[2], tag, 6u);
    disco_firmware_receive(core, now, 0x0F0u + (id - 0x100u), proof, 8u);
}

static void host(disco_firmware_t *core, uint64_t now, const disco_outputs_t *out, uint8_t session)
{
    static uint8_t host_counter, command_counter;
    uint8_t data[8];
    const uint8_t major = DISCO_PROTOCOL_MAJOR;
    if (now % 1000000u == 0u) {
        struct disco_robot_hello_request_t hello = {.protocol_major = major, .dbc_hash = DISCO_DBC_HASH};
        (void)disco_robot_hello_request_pack(data, &hello, 8u);
        receive(core, now, DISCO_ROBOT_HELLO_REQUEST_FRAME_ID, data, DISCO_HELLO_REQUEST_DATA_ID(major));
    }
    if (now % 50000u == 0u) {
        struct disco_robot_host_state_t state = {.counter = host_counter, .session = session};
        host_counter = (host_counter + 1u) & 15u;
        state.request = DISCO_REQUEST_READY;
        if (out->state == DISCO_STATE_READY || out->state == DISCO_STATE_ARMED) {
            state.request = DISCO_REQUEST_ARM;
        } else if ((out->state == DISCO_STATE_FAULT || out->state == DISCO_STATE_ESTOP) && now % 1000000u > 200000u) {
            state.request = DISCO_REQUEST_RESET;
        }
        state.challenge_answer = disco_challenge_answer(core->session.challenge, session, DISCO_DBC_HASH);
        (void)disco_robot_host_state_pack(data, &state, 8u);
        data[0] = disco_e2e_crc(data, DISCO_HOST_STATE_DATA_ID(major));
        prove(core, now, DISCO_ROBOT_HOST_STATE_FRAME_ID, data);
        receive(core, now, DISCO_ROBOT_HOST_STATE_FRAME_ID, data, DISCO_HOST_STATE_DATA_ID(major));
    }
    if (now % 20000u == 0u) {
        struct disco_robot_wheel_command_t command = {.counter = command_counter, .session = session, .valid_for = 50u};
        command_counter = (command_counter + 1u) & 15u;
        command.mode = chance(4u) ? (uint8_t)(random_u32() % 4u) : DISCO_MODE_SPEED;
        if (out->state == DISCO_STATE_ARMED && command.mode == DISCO_MODE_SPEED) {
            command.left_speed = (int16_t)random_u32();
            command.right_speed = (int16_t)random_u32();
        }
        (void)disco_robot_wheel_command_pack(data, &command, 8u);
        data[0] = disco_e2e_crc(data, DISCO_WHEEL_COMMAND_DATA_ID(major));
        prove(core, now, DISCO_ROBOT_WHEEL_COMMAND_FRAME_ID, data);
        receive(core, now, DISCO_ROBOT_WHEEL_COMMAND_FRAME_ID, data, DISCO_WHEEL_COMMAND_DATA_ID(major));
    }
}

static void intruder(disco_firmware_t *core, uint64_t now)
{
    static const uint32_t ids[] = {0x100u, 0x101u, 0x102u, 0x150u, 0x160u, 0x0F0u, 0x0F1u, 0x0F2u};
    uint8_t data[8];
    for (uint8_t i = 0u; i < 8u; i++) {
        data[i] = (uint8_t)random_u32();
    }
    if (chance(3u)) {
        /* Parameters first, so that random floats reach their table. */
        const uint32_t id = ids[random_u32() % 8u];
        const uint8_t major = (id == 0x102u) ? 0u : DISCO_PROTOCOL_MAJOR;
        if (id == 0x160u) {
            data[2] = (uint8_t)(random_u32() % 8u);
            data[3] = 0u;
        }
        receive(core, now, id, data, (uint16_t)(id ^ ((uint32_t)major << 11)));
    } else {
        disco_firmware_receive(core, now, random_u32() % 0x800u, data, (uint8_t)(random_u32() % 9u));
    }
}

/* Arguments: cycles; random frames in each cycle of a flood, which lasts a tenth of the time; 1 for authenticated. */
/* Random bytes for the decoders of both lines, from little text to endless one. */
static void noise(void)
{
    static disco_serial_decoder_t serial;
    static disco_slcan_t slcan;
    uint8_t replies[DISCO_SLCAN_ENCODED];
    disco_frame_t frame;
    for (uint32_t i = 0u; i < 4u; i++) {
        static const char letters[] = "tTrROLCSVNFZ0123456789ABCDEFabcdef\a";
        const uint8_t letter = (uint8_t)letters[random_u32() % (sizeof(letters) - 1u)];
        (void)disco_serial_feed(&serial, chance(12u) ? 0u : (uint8_t)random_u32(), &frame);
        (void)disco_slcan_feed(&slcan, chance(12u) ? (uint8_t)'\r' : letter, &frame);
    }
    if (chance(4u)) {
        (void)disco_slcan_reply(&slcan, replies);
    }
}

int main(int argc, char **argv)
{
    const uint32_t cycles = (uint32_t)strtoul(argv[1], NULL, 10);
    const uint32_t flood = (argc > 2) ? (uint32_t)strtoul(argv[2], NULL, 10) : 0u;
    disco_config_t robot = disco_config_default(2048u, 8.0f);
    uint64_t frames = 0u;
    static disco_firmware_t core;
    uint32_t seen[7] = {0u};
    double ticks[2] = {0.0, 0.0};
    disco_outputs_t out = {.state = DISCO_STATE_BOOT};
    uint64_t now = 0u;
    bool mad = false;
    robot.authenticated = (argc > 3) && (argv[3][0] == '1');
    seed = UINT64_C(0x9E3779B97F4A7C15);
    uint8_t record[DISCO_RECORD_LENGTH];
    disco_record_pack(&robot, record);
    disco_config_t kept = robot;
    if (!disco_record_unpack(record, &kept)) {
        (void)printf("a record that was packed is not read\n");
        return 1;
    }
    disco_firmware_init(&core, &kept, 1u, 0u);
    for (uint32_t cycle = 1u; cycle <= cycles; cycle++) {
        disco_inputs_t in = {.temperature = {25.0f, 25.0f}, .encoder_valid = {true, true}, .voltage = 24.0f};
        disco_frame_t frame;
        now += 1000u;
        host(&core, now, &out, (uint8_t)(1u + (cycle / 700u) % 255u));
        const uint32_t strangers = ((cycle % 5000u) < 500u) ? flood : (chance(60u) ? 1u : 0u);
        for (uint32_t i = 0u; i < strangers; i++) {
            intruder(&core, now);
        }
        frames += strangers;
        if ((flood > 0u) && ((cycle % 5000u) == 500u)) {
            /* What strangers may write without a key, parameters among it, would keep the robot standing. */
            disco_firmware_init(&core, &robot, cycle, 0u);
        }
        mad = chance(3000u) || (mad && !chance(20u));
        in.wheel_speed[0] = out.left_setpoint;
        in.wheel_speed[1] = out.right_setpoint;
        ticks[0] += out.left_setpoint * 0.326;
        ticks[1] += out.right_setpoint * 0.326;
        in.ticks[0] = (uint32_t)(int64_t)ticks[0];
        in.ticks[1] = (uint32_t)(int64_t)ticks[1];
        if (mad) {
            in.wheel_speed[random_u32() % 2u] = mad_float();
            in.current[random_u32() % 2u] = mad_float();
            in.voltage = mad_float();
            in.battery_current = mad_float();
            in.temperature[random_u32() % 2u] = mad_float();
            in.ticks[random_u32() % 2u] = random_u32();
            in.tx_error_count = (uint16_t)random_u32();
            in.estop_button = chance(10u);
            now += chance(50u) ? (uint64_t)random_u32() * 16u : 0u;
            now -= now % 1000u;
        }
        const disco_pose_t pose =
            disco_pose(mad ? mad_float() : 1.0f, 2.0f, mad ? mad_float() : 3.0f, 0.01f, mad ? mad_float() : 0.01f);
        disco_firmware_pose(&core, &pose, now);
        noise();
        disco_firmware_step(&core, now, &in, &out);
        seen[out.state]++;
        const bool may_move = out.state == DISCO_STATE_ARMED || out.state == DISCO_STATE_STOPPING ||
                              out.state == DISCO_STATE_ESTOP;
        if (!(fabsf(out.left_setpoint) <= 8.0f) || !(fabsf(out.right_setpoint) <= 8.0f) ||
            (out.driver_enabled && !may_move)) {
            (void)printf("cycle %u: state %u, setpoints %g %g\n", cycle, out.state, (double)out.left_setpoint,
                         (double)out.right_setpoint);
            return 1;
        }
        while (!chance(3u) && disco_firmware_pop(&core, &frame)) {
        }
    }
    (void)printf("%u %u %u %u %u %u %u %llu\n", seen[0], seen[1], seen[2], seen[3], seen[4], seen[5], seen[6],
                 (unsigned long long)frames);
    return 0;
}
