/* Runs the core on an emulated Cortex-M and prints what it costs: instructions in steps and in receptions, the deepest
 * stack, RAM. QEMU is told that an instruction takes 1024 ns, so that a timer counts them; what it prints goes out by
 * semihosting. The robot is driven for ten seconds: handshake, arming, a drive, a host that falls silent, an emergency
 * stop and its reset, all with a host at its usual rates. */
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#include "disco_robot.h"
#include "firmware.h"
#include "interrupts.h"
#include "protocol_constants.h"

#define STEPS (10000u)
#define STACK_BYTES (4096u)
#define PAINT (0xA5u)
#define SYSTICK_CONTROL (*(volatile uint32_t *)0xE000E010u)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xE000E014u)
#define SYSTICK_VALUE (*(volatile uint32_t *)0xE000E018u)
#define TICK_NS (40u)
#define INSTRUCTION_NS (1024u)

void nmi_handler(void) {}
void systick_handler(void) {}
void link_receive_handler(void) {}
void bench_receive_handler(void) {}

typedef struct {
    uint32_t count, sum, most, when;
} cost_t;

static disco_firmware_t core;
static disco_outputs_t out;
static disco_inputs_t inputs;
static cost_t steps, receptions, poses;
static uint32_t now_ms, overhead, begun;

static void host_call(uint32_t what, const void *with)
{
    register uint32_t r0 __asm("r0") = what;
    register const void *r1 __asm("r1") = with;
    __asm volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
}

static void print(const char *name, uint32_t value)
{
    char text[40];
    char digits[12];
    uint32_t at = (uint32_t)strlen(name);
    uint32_t count = 0u;
    (void)memcpy(text, name, at);
    text[at++] = ' ';
    do {
        digits[count++] = (char)('0' + (value % 10u));
        value /= 10u;
    } while (value > 0u);
    while (count > 0u) {
        text[at++] = digits[--count];
    }
    text[at++] = '\n';
    text[at] = '\0';
    host_call(4u, text);
}

static __attribute__((noinline)) void begin(void)
{
    begun = SYSTICK_VALUE;
}

static __attribute__((noinline)) uint32_t end(void)
{
    const uint32_t ticks = (begun - SYSTICK_VALUE) & 0x00FFFFFFu;
    return ((ticks * (TICK_NS / 8u)) + (INSTRUCTION_NS / 16u)) / (INSTRUCTION_NS / 8u);
}

static void add(cost_t *cost, uint32_t instructions)
{
    const uint32_t own = instructions - overhead;
    cost->count++;
    cost->sum += own;
    if (own > cost->most) {
        cost->most = own;
        cost->when = now_ms;
    }
}

static void receive(uint16_t can_id, const uint8_t *data)
{
    begin();
    disco_firmware_receive(&core, (uint64_t)now_ms * 1000u, can_id, data, 8u);
    add(&receptions, end());
}

/* Proves a frame as a host with the key does; the nonce is read where the robot would tell it. */
static void prove(uint16_t can_id, const uint8_t *frame)
{
    static uint64_t freshness[DISCO_PROOFS];
    static uint8_t nonce[DISCO_NONCE_LENGTH];
    uint8_t message[24], tag[16], proof[8];
    if (memcmp(nonce, core.authentication.nonce, sizeof(nonce)) != 0) {
        (void)memcpy(nonce, core.authentication.nonce, sizeof(nonce));
        (void)memset(freshness, 0, sizeof(freshness));
    }
    const uint64_t fresh = ++freshness[can_id - 0x100u];
    (void)memcpy(message, nonce, sizeof(nonce));
    for (uint8_t i = 0u; i < 8u; i++) {
        message[6u + i] = (uint8_t)(fresh >> (8u * i));
    }
    message[14] = (uint8_t)can_id;
    message[15] = (uint8_t)(can_id >> 8);
    (void)memcpy(&message[16], frame, 8u);
    disco_cmac(&core.authentication.key, message, sizeof(message), tag);
    proof[0] = message[6];
    proof[1] = message[7];
    (void)memcpy(&proof[2], tag, 6u);
    receive((uint16_t)(can_id - 0x10u), proof);
}

static void seal_and_send(uint16_t can_id, uint8_t *data, uint16_t data_id, bool proved)
{
    data[0] = disco_e2e_crc(data, data_id);
    if (proved && core.config.authenticated) {
        prove(can_id, data);
    }
    receive(can_id, data);
}

static void host(void)
{
    static uint8_t counter[2];
    const uint8_t major = DISCO_PROTOCOL_MAJOR;
    const bool silent = (now_ms > 7000u) && (now_ms <= 8000u);
    uint8_t data[8];
    if (((now_ms == 300u) || (now_ms % 1000u == 503u)) && !silent) {
        struct disco_robot_hello_request_t hello = {.protocol_major = major, .dbc_hash = DISCO_DBC_HASH};
        struct disco_robot_time_request_t ask = {.sequence = 1u};
        (void)disco_robot_hello_request_pack(data, &hello, 8u);
        seal_and_send(DISCO_ROBOT_HELLO_REQUEST_FRAME_ID, data, DISCO_HELLO_REQUEST_DATA_ID(major), false);
        (void)disco_robot_time_request_pack(data, &ask, 8u);
        seal_and_send(DISCO_ROBOT_TIME_REQUEST_FRAME_ID, data, DISCO_TIME_REQUEST_DATA_ID(major), false);
    }
    if (now_ms == 8500u) {
        receive(DISCO_ROBOT_ESTOP_FRAME_ID, data);
    }
    if ((now_ms % 50u == 0u) && !silent) {
        struct disco_robot_host_state_t state = {.counter = counter[0], .session = (now_ms < 8000u) ? 7u : 9u};
        state.request = (out.state >= DISCO_STATE_READY) ? DISCO_REQUEST_ARM : DISCO_REQUEST_READY;
        if ((out.state == DISCO_STATE_ESTOP) && (now_ms >= 9300u)) {
            state.request = DISCO_REQUEST_RESET;
        }
        state.challenge_answer = disco_challenge_answer(core.session.challenge, state.session, DISCO_DBC_HASH);
        counter[0] = (counter[0] + 1u) & 15u;
        (void)disco_robot_host_state_pack(data, &state, 8u);
        seal_and_send(DISCO_ROBOT_HOST_STATE_FRAME_ID, data, DISCO_HOST_STATE_DATA_ID(major), true);
    }
    if ((now_ms % 20u == 0u) && !silent && (out.state != DISCO_STATE_ESTOP)) {
        struct disco_robot_wheel_command_t command = {.counter = counter[1], .session = out.session, .valid_for = 50u};
        command.mode = DISCO_MODE_SPEED;
        if (out.state == DISCO_STATE_ARMED) {
            command.left_speed = (int16_t)(now_ms % 3000u);
            command.right_speed = (int16_t)(1500 - (int32_t)(now_ms % 2500u));
        }
        counter[1] = (counter[1] + 1u) & 15u;
        (void)disco_robot_wheel_command_pack(data, &command, 8u);
        seal_and_send(DISCO_ROBOT_WHEEL_COMMAND_FRAME_ID, data, DISCO_WHEEL_COMMAND_DATA_ID(major), true);
    }
}

static void wheels(void)
{
    static float angle[2];
    const float speed[2] = {out.left_setpoint, out.right_setpoint};
    for (uint8_t side = 0u; side < 2u; side++) {
        angle[side] += speed[side] * (0.001f * 2048.0f / 6.2831853f);
        inputs.ticks[side] = (uint32_t)(int32_t)angle[side];
        inputs.wheel_speed[side] = speed[side];
        inputs.current[side] = (speed[side] != 0.0f) ? 0.8f : 0.0f;
        inputs.temperature[side] = 31.4f;
        inputs.encoder_valid[side] = true;
    }
    inputs.voltage = 24.6f;
}

static __attribute__((noinline)) void drive(void)
{
    disco_frame_t frame;
    for (now_ms = 1u; now_ms <= STEPS; now_ms++) {
        host();
        wheels();
        begin();
        disco_firmware_step(&core, (uint64_t)now_ms * 1000u, &inputs, &out);
        while (disco_firmware_pop(&core, &frame)) {
        }
        add(&steps, end());
        if (now_ms % 40u == 17u) {
            const disco_pose_t pose = disco_pose(1.234f, -0.5f, 1.57f, 0.01f, 0.01f);
            begin();
            disco_firmware_pose(&core, &pose, (uint64_t)now_ms * 1000u);
            add(&poses, end());
        }
    }
}

static uint8_t *stack_pointer(void)
{
    uint8_t *pointer;
    __asm volatile("mov %0, sp" : "=r"(pointer));
    return pointer;
}

int main(void)
{
    disco_config_t config = disco_config_default(2048u, 8.0f);
#if defined(WITH_KEY)
    config.authenticated = true;
#endif
    SYSTICK_RELOAD = 0x00FFFFFFu;
    SYSTICK_VALUE = 0u;
    SYSTICK_CONTROL = 5u;
    begin();
    overhead = end();
    volatile uint8_t *const top = stack_pointer() - 16;
    volatile uint8_t *const bottom = top - STACK_BYTES;
    for (volatile uint8_t *at = bottom; at < top; at++) {
        *at = PAINT;
    }
    disco_firmware_init(&core, &config, 12345u, 0u);
    drive();
    volatile uint8_t *deepest = bottom;
    while ((deepest < top) && (*deepest == PAINT)) {
        deepest++;
    }
    print("step_mean", steps.sum / steps.count);
    print("step_worst", steps.most);
    print("step_worst_ms", steps.when);
    print("reception_mean", receptions.sum / receptions.count);
    print("reception_worst", receptions.most);
    print("pose_worst", poses.most);
    print("stack", (uint32_t)(top - deepest));
    print("ram", sizeof(core));
    print("accepted", out.accepted_commands);
    print("watchdog_events", out.watchdog_events);
    print("state", out.state);
    host_call(0x18u, (const void *)0x20026);
    for (;;) {
    }
}
