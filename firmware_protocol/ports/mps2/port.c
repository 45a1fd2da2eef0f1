/* ARM's MPS2 board (AN385: Cortex-M3, AN386: Cortex-M4F) as QEMU emulates it, with the plant of plant.c around it.
 * UART 0 is the link; UART 1 the test bench: it tells what truly happens and does to the board what a person could. */
#include "port.h"

#include <string.h>

#include "interrupts.h"
#include "plant.h"
#include "queue.h"

#define CLOCK_HZ (25000000u)

typedef struct {
    volatile uint32_t data, state, control, interrupt, divider;
} uart_t;

#define LINK ((uart_t *)0x40004000u)
#define BENCH ((uart_t *)0x40005000u)
#define UART_SENDING (1u) /* state: no room for a byte */
#define UART_RECEIVED (2u) /* state and interrupt */
#define UART_ENABLE (1u | 2u | 8u) /* send, receive, receive interrupt */

#define COUNTER (*(volatile uint32_t *)0x40028018u)
#define COUNTER_DIVIDER (*(volatile uint32_t *)0x4002801Cu)

typedef struct {
    volatile uint32_t load, value, control, clear;
} watchdog_t;

#define WATCHDOG ((watchdog_t *)0x40008000u)
/* An emulator may be held up by its host: on a board take 20 to 50 ms. */
#define WATCHDOG_HZ (2u)

#define SYSTICK_CONTROL (*(volatile uint32_t *)0xE000E010u)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xE000E014u)
#define INTERRUPTS_ON (*(volatile uint32_t *)0xE000E100u)
#define RESET_CONTROL (*(volatile uint32_t *)0xE000ED0Cu)
#define RESET_NOW (0x05FA0004u)

#define CYCLE_US (1000u)
#define POSE_PERIOD_US (40000u)
#define POSE_DELAY_US (30000u)
#define TRUTH_PERIOD_US (10000u)

/* What the emulator is started with: written by its host before each reset. */
typedef struct {
    uint32_t entropy[2];
    uint32_t first_us;
    uint32_t authenticated;
    uint8_t key[DISCO_KEY_LENGTH];
} settings_t;

/* What a reset leaves alone, in the place of flash and of a reset cause register. */
typedef struct {
    uint32_t starts;
    uint32_t cause;
    uint64_t last_entropy;
    uint32_t stored;
    uint8_t record[DISCO_RECORD_LENGTH];
} kept_t;

/* At fixed places: what the linker knows of, the emulator clears at a reset. */
#define settings (*(volatile settings_t *)0x20000000u)
#define kept (*(volatile kept_t *)0x20001000u)

static disco_queue_t received, bench_received;
static plant_t plant;
static disco_outputs_t driven;
static disco_pose_t pose;
static uint32_t stepped_us, posed_us, told_us, fed_us;
static bool pose_waits, button, held_up;

static void restart(disco_reset_cause_t cause)
{
    kept.cause = (uint32_t)cause;
    RESET_CONTROL = RESET_NOW;
    for (;;) {
    }
}

void nmi_handler(void)
{
    /* The watchdog's warning: nobody has fed it, and nobody will. */
    kept.cause = (uint32_t)DISCO_RESET_WATCHDOG;
    for (;;) {
    }
}

void systick_handler(void) {}

void link_receive_handler(void)
{
    /* Acknowledged before it is read: a byte that comes in between raises it again, and none is left lying. */
    LINK->interrupt = UART_RECEIVED;
    while ((LINK->state & UART_RECEIVED) != 0u) {
        const uint8_t byte = (uint8_t)LINK->data;
        (void)disco_queue_put(&received, &byte, 1u);
    }
}

void bench_receive_handler(void)
{
    BENCH->interrupt = UART_RECEIVED;
    while ((BENCH->state & UART_RECEIVED) != 0u) {
        const uint8_t byte = (uint8_t)BENCH->data;
        (void)disco_queue_put(&bench_received, &byte, 1u);
    }
}

/* What a person could do. */
static void obey(uint8_t what)
{
    if (what == (uint8_t)'r') {
        restart(DISCO_RESET_POWER_ON);
    } else if (what == (uint8_t)'b') {
        restart(DISCO_RESET_BROWN_OUT);
    } else if (what == (uint8_t)'h') {
        for (;;) { /* only the hardware watchdog helps */
        }
    } else if (what == (uint8_t)'p') {
        button = !button;
    } else {
        /* nothing that we know */
    }
}

disco_reset_cause_t port_start(disco_config_t *config)
{
    const disco_reset_cause_t cause = (disco_reset_cause_t)kept.cause;
    kept.cause = (uint32_t)DISCO_RESET_POWER_ON;
    kept.starts++;
    config->authenticated = settings.authenticated != 0u;
    for (uint8_t i = 0u; i < (uint8_t)DISCO_KEY_LENGTH; i++) {
        config->key[i] = settings.key[i];
    }
    COUNTER_DIVIDER = (CLOCK_HZ / 1000000u) - 1u;
    COUNTER = settings.first_us;
    LINK->divider = BENCH->divider = 27u; /* 921 600 Bd */
    LINK->control = BENCH->control = UART_ENABLE;
    INTERRUPTS_ON = (1u << 0) | (1u << 2);
    SYSTICK_RELOAD = (CLOCK_HZ / 1000u) - 1u;
    SYSTICK_CONTROL = 7u;
    WATCHDOG->load = CLOCK_HZ / WATCHDOG_HZ;
    WATCHDOG->control = 3u;
    plant_init(&plant);
    stepped_us = posed_us = told_us = fed_us = settings.first_us;
    return cause;
}

/* The emulator is held up by its computer now and then, for longer than the core lets a clock leap. It makes up for that:
 * time goes on by one cycle for each cycle until it has caught up, and what came meanwhile is taken in then. A board's
 * time is its counter's, and nothing else. */
uint32_t port_now_us(void)
{
    const uint32_t read_us = COUNTER;
    held_up = (read_us - fed_us) > CYCLE_US;
    return held_up ? (fed_us + CYCLE_US) : read_us;
}

size_t port_receive(uint8_t *bytes, size_t most)
{
    return held_up ? 0u : disco_queue_take(&received, bytes, most);
}

static size_t send(uart_t *uart, const uint8_t *bytes, size_t count)
{
    size_t sent = 0u;
    while ((sent < count) && ((uart->state & UART_SENDING) == 0u)) {
        uart->data = bytes[sent];
        sent++;
    }
    return sent;
}

size_t port_send(const uint8_t *bytes, size_t count)
{
    return send(LINK, bytes, count);
}

#if defined(DISCO_PLANT_LINE)
/* The bench's place: there is nothing to tell of a plant that is elsewhere. */
size_t port_plant_receive(uint8_t *bytes, size_t most)
{
    return disco_queue_take(&bench_received, bytes, most);
}

size_t port_plant_send(const uint8_t *bytes, size_t count)
{
    return send(BENCH, bytes, count);
}
#endif

uint64_t port_entropy(uint64_t *last)
{
    /* A generator's word, and a count of starts for where there is none. */
    const uint64_t entropy = (((uint64_t)settings.entropy[1] << 32) | settings.entropy[0]) + kept.starts;
    *last = kept.last_entropy;
    kept.last_entropy = entropy;
    return entropy;
}

static uint8_t *put(uint8_t *text, int32_t value)
{
    uint8_t digits[10];
    uint8_t count = 0u;
    uint32_t left = (value < 0) ? (0u - (uint32_t)value) : (uint32_t)value;
    if (value < 0) {
        *text++ = (uint8_t)'-';
    }
    do {
        digits[count++] = (uint8_t)('0' + (left % 10u));
        left /= 10u;
    } while (left > 0u);
    while (count > 0u) {
        *text++ = digits[--count];
    }
    *text++ = (uint8_t)' ';
    return text;
}

/* One line for the bench: start, ms, setpoints and speeds (mrad/s), pose (0.1 mm, 0.1 mrad), state, commands taken. */
static void tell_truth(uint32_t now_us)
{
    uint8_t line[160];
    uint8_t *end = put(line, (int32_t)kept.starts);
    end = put(end, (int32_t)(now_us / 1000u));
    end = put(end, (int32_t)(driven.left_setpoint * 1.0e3f));
    end = put(end, (int32_t)(driven.right_setpoint * 1.0e3f));
    end = put(end, (int32_t)(plant.speed[0] * 1.0e3f));
    end = put(end, (int32_t)(plant.speed[1] * 1.0e3f));
    end = put(end, (int32_t)(plant.x * 1.0e4f));
    end = put(end, (int32_t)(plant.y * 1.0e4f));
    end = put(end, (int32_t)(plant.yaw * 1.0e4f));
    end = put(end, (int32_t)driven.state);
    end = put(end, (int32_t)driven.accepted_commands);
    end[-1] = (uint8_t)'\n';
    (void)send(BENCH, line, (size_t)(end - line));
}

void port_measure(port_measurement_t *measurement)
{
    const uint32_t now_us = port_now_us();
    uint8_t what;
    while (disco_queue_take(&bench_received, &what, 1u) == 1u) {
        obey(what);
    }
    plant_step(&plant, &driven, (float)(now_us - stepped_us) * 1.0e-6f);
    stepped_us = now_us;
    plant_read(&plant, &measurement->inputs);
    measurement->inputs.estop_button = button;
    if ((now_us - posed_us) >= POSE_PERIOD_US) {
        posed_us = now_us;
        pose = plant_pose(&plant);
        pose_waits = true;
    }
    if (pose_waits && ((now_us - posed_us) >= POSE_DELAY_US)) {
        pose_waits = false;
        measurement->pose = pose;
        measurement->pose_us = posed_us;
        measurement->posed = true;
    }
    if ((now_us - told_us) >= TRUTH_PERIOD_US) {
        told_us += TRUTH_PERIOD_US;
        tell_truth(now_us);
    }
}

void port_drive(const disco_outputs_t *outputs)
{
    driven = *outputs;
}

void port_feed_watchdog(void)
{
    WATCHDOG->clear = 1u;
    fed_us = port_now_us();
}

bool port_load(uint8_t *record)
{
    for (uint8_t i = 0u; i < (uint8_t)DISCO_RECORD_LENGTH; i++) {
        record[i] = kept.record[i];
    }
    return kept.stored != 0u;
}

void port_store(const uint8_t *record)
{
    for (uint8_t i = 0u; i < (uint8_t)DISCO_RECORD_LENGTH; i++) {
        kept.record[i] = record[i];
    }
    kept.stored = 1u;
}

void port_wait(void)
{
    __asm volatile("wfi");
}
