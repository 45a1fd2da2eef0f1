/* RP2040 with the Pico SDK: the USB-CDC or UART line, the 64-bit timer, encoders by PIO, PWM. Compiled against stub
 * headers in the tests; NOT RUN ON HARDWARE. The core and this loop run on core 0. */
#include "port.h"

#include "hardware/clocks.h"
#include "hardware/gpio.h"
#include "hardware/irq.h"
#include "hardware/pwm.h"
#include "hardware/uart.h"
#include "hardware/watchdog.h"
#include "pico/rand.h"
#include "pico/stdlib.h"
#include "quadrature.h"
#include "queue.h"

#define TICKS_PER_REV (2048u)
#define MAX_WHEEL_SPEED (8.0f)
#define TWO_PI (6.2831853f)
#define SPEED_FILTER_S (0.01f)
#define PWM_WRAP (1000u)
#define WATCHDOG_MS (30u)
#define LINK uart0
#define BAUD (921600u)

enum { PIN_TX = 0, PIN_RX = 1, PIN_LEFT_A = 2, PIN_RIGHT_A = 4, PIN_LEFT_PWM = 6, PIN_RIGHT_PWM = 8, PIN_LEFT_DIR = 10,
       PIN_RIGHT_DIR = 11, PIN_ENABLE = 12, PIN_BRAKE = 13, PIN_ESTOP = 14 };

static disco_queue_t received;
static int32_t last_count[2];

static void link_interrupt(void)
{
    while (uart_is_readable(LINK)) {
        const uint8_t byte = (uint8_t)uart_getc(LINK);
        (void)disco_queue_put(&received, &byte, 1u);
    }
}

static bool each_millisecond(repeating_timer_t *timer)
{
    (void)timer;
    return true; /* it only wakes port_wait */
}

static void output(uint32_t pin, bool level)
{
    gpio_init(pin);
    gpio_set_dir(pin, true);
    gpio_put(pin, level);
}

disco_reset_cause_t port_start(disco_config_t *config)
{
    static repeating_timer_t timer;
    output(PIN_ENABLE, false);
    output(PIN_BRAKE, true);
    output(PIN_LEFT_DIR, false);
    output(PIN_RIGHT_DIR, false);
    gpio_init(PIN_ESTOP);
    gpio_pull_up(PIN_ESTOP);
    gpio_set_function(PIN_LEFT_PWM, GPIO_FUNC_PWM);
    gpio_set_function(PIN_RIGHT_PWM, GPIO_FUNC_PWM);
    for (uint32_t pin = PIN_LEFT_PWM; pin <= (uint32_t)PIN_RIGHT_PWM; pin += 2u) {
        pwm_set_wrap(pwm_gpio_to_slice_num(pin), PWM_WRAP);
        pwm_set_enabled(pwm_gpio_to_slice_num(pin), true);
    }
    quadrature_start(0u, PIN_LEFT_A);
    quadrature_start(1u, PIN_RIGHT_A);
    (void)uart_init(LINK, BAUD);
    gpio_set_function(PIN_TX, GPIO_FUNC_UART);
    gpio_set_function(PIN_RX, GPIO_FUNC_UART);
    irq_set_exclusive_handler(UART0_IRQ, link_interrupt);
    irq_set_enabled(UART0_IRQ, true);
    uart_set_irq_enables(LINK, true, false);
    (void)add_repeating_timer_us(-1000, each_millisecond, NULL, &timer);
    /* The RP2040 does not tell a brown-out from a power-on. Read before the watchdog is enabled, and not with
     * watchdog_caused_reboot, which is true after each flashing, too. */
    const bool hung = watchdog_enable_caused_reboot();
    watchdog_enable(WATCHDOG_MS, false); /* not paused by the debugger: the PWM runs on */
    config->ticks_per_rev = TICKS_PER_REV;
    config->max_wheel_speed = MAX_WHEEL_SPEED;
    config->board_id = 0x2040u;
    return hung ? DISCO_RESET_WATCHDOG : DISCO_RESET_POWER_ON;
}

uint32_t port_now_us(void)
{
    return time_us_32();
}

size_t port_receive(uint8_t *bytes, size_t most)
{
    return disco_queue_take(&received, bytes, most);
}

size_t port_send(const uint8_t *bytes, size_t count)
{
    size_t sent = 0u;
    while ((sent < count) && uart_is_writable(LINK)) {
        uart_putc_raw(LINK, (char)bytes[sent]);
        sent++;
    }
    return sent;
}

uint64_t port_entropy(uint64_t *last)
{
    *last = 0u; /* not remembered: the generator is trusted */
    return get_rand_64();
}

void port_measure(port_measurement_t *measurement)
{
    static uint32_t measured_us;
    disco_inputs_t *inputs = &measurement->inputs;
    /* Cycles that were late come one after the other: the time that passed is not always the cycle's. */
    const uint32_t now_us = port_now_us();
    const float passed_s = (float)(now_us - measured_us) * 1.0e-6f;
    measured_us = now_us;
    for (uint8_t side = 0u; side < 2u; side++) {
        const int32_t count = quadrature_count(side);
        const float angle = (float)(count - last_count[side]) * (TWO_PI / (float)TICKS_PER_REV);
        last_count[side] = count;
        inputs->ticks[side] = (uint32_t)count;
        inputs->wheel_speed[side] += (angle - (inputs->wheel_speed[side] * passed_s)) / SPEED_FILTER_S;
        inputs->encoder_valid[side] = true;
        inputs->temperature[side] = 25.0f;
    }
    inputs->estop_button = gpio_get(PIN_ESTOP); /* a broken wire stops: the button opens, the pull-up lifts */
}

static void drive_wheel(uint32_t pwm, uint32_t direction, float setpoint)
{
    const float part = setpoint * ((float)PWM_WRAP / MAX_WHEEL_SPEED);
    gpio_put(direction, part < 0.0f);
    pwm_set_gpio_level(pwm, (uint16_t)(part < 0.0f ? -part : part));
}

void port_drive(const disco_outputs_t *outputs)
{
    /* Feed-forward alone: a speed loop of your own goes here. */
    drive_wheel(PIN_LEFT_PWM, PIN_LEFT_DIR, outputs->left_setpoint);
    drive_wheel(PIN_RIGHT_PWM, PIN_RIGHT_DIR, outputs->right_setpoint);
    gpio_put(PIN_ENABLE, outputs->driver_enabled);
    gpio_put(PIN_BRAKE, outputs->brake);
}

void port_feed_watchdog(void)
{
    watchdog_update();
}

bool port_load(uint8_t *record)
{
    (void)record;
    return false;
}

/* Flash cannot be written while code runs from it: parameters last until the next start. */
void port_store(const uint8_t *record)
{
    (void)record;
}

void port_wait(void)
{
    __wfi();
}
