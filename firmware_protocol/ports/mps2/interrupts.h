/* The handlers in the vector table. */
#ifndef DISCO_MPS2_INTERRUPTS_H
#define DISCO_MPS2_INTERRUPTS_H

void nmi_handler(void);
void systick_handler(void);
void link_receive_handler(void);
void bench_receive_handler(void);

#endif
