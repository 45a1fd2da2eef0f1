/* The part of the Pico SDK that the skeleton uses: declarations alone. */
#ifndef STUB_PICO_H
#define STUB_PICO_H
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
typedef unsigned int uint;
typedef struct repeating_timer repeating_timer_t;
struct repeating_timer { int64_t delay_us; };
typedef bool (*repeating_timer_callback_t)(repeating_timer_t *timer);
bool add_repeating_timer_us(int64_t delay_us, repeating_timer_callback_t callback, void *data, repeating_timer_t *out);
uint32_t time_us_32(void);
void __wfi(void);
typedef struct uart_inst uart_inst_t;
extern uart_inst_t *const uart0;
uint uart_init(uart_inst_t *uart, uint baud);
bool uart_is_readable(uart_inst_t *uart);
bool uart_is_writable(uart_inst_t *uart);
char uart_getc(uart_inst_t *uart);
void uart_putc_raw(uart_inst_t *uart, char c);
void uart_set_irq_enables(uart_inst_t *uart, bool receive, bool transmit);
enum { UART0_IRQ = 20 };
typedef void (*irq_handler_t)(void);
void irq_set_exclusive_handler(uint number, irq_handler_t handler);
void irq_set_enabled(uint number, bool enabled);
enum gpio_function { GPIO_FUNC_UART = 2, GPIO_FUNC_PWM = 4 };
void gpio_init(uint pin);
void gpio_set_dir(uint pin, bool out);
void gpio_put(uint pin, bool value);
bool gpio_get(uint pin);
void gpio_pull_up(uint pin);
void gpio_set_function(uint pin, enum gpio_function function);
uint pwm_gpio_to_slice_num(uint pin);
void pwm_set_wrap(uint slice, uint16_t wrap);
void pwm_set_enabled(uint slice, bool enabled);
void pwm_set_gpio_level(uint pin, uint16_t level);
bool watchdog_enable_caused_reboot(void);
void watchdog_enable(uint32_t delay_ms, bool pause_on_debug);
void watchdog_update(void);
uint64_t get_rand_64(void);
#endif
