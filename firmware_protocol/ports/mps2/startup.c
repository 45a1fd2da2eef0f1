/* From reset to main on a Cortex-M; the C library's own start code is left out. */
#include <stdint.h>

#include "interrupts.h"

extern uint32_t stack_top[], data_source[], data_start[], data_end[], bss_start[], bss_end[];
int main(void);
void reset_handler(void);

#define CPACR (*(volatile uint32_t *)0xE000ED88u)

void reset_handler(void)
{
    const uint32_t *from = data_source;
    for (uint32_t *to = data_start; to < data_end; to++) {
        *to = *from;
        from++;
    }
    for (uint32_t *to = bss_start; to < bss_end; to++) {
        *to = 0u;
    }
#if defined(__ARM_FP)
    CPACR |= 0xFu << 20;
    __asm volatile("dsb\nisb");
#endif
    (void)main();
    for (;;) {
    }
}

static void stuck(void)
{
    for (;;) {
    }
}

typedef void (*handler_t)(void);

__attribute__((section(".vectors"), used)) static const handler_t vectors[16 + 4] = {
    (handler_t)(uintptr_t)stack_top,
    reset_handler,
    nmi_handler,
    [3] = stuck, /* hard fault: the hardware watchdog ends it */
    [4] = stuck,
    [5] = stuck,
    [6] = stuck,
    [15] = systick_handler,
    [16] = link_receive_handler, /* UART 0 */
    [18] = bench_receive_handler, /* UART 1 */
};
