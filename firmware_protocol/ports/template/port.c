/* A port to begin with: copy this folder, and fill in the eleven functions in the order of docs/port.md. As it stands it
 * compiles, and a host hears nothing from it. */
#include "port.h"

#include "queue.h"

/* Filled by the link's interrupt, emptied by the main loop. */
static disco_queue_t received;

/* The vendor's handler of the link's interrupt. Acknowledge the interrupt BEFORE reading: what comes in between raises it
 * again. Read until nothing is left. Nothing else of the firmware may be called from here. */
#if defined(DISCO_LINK_CAN)
void link_interrupt(const disco_frame_t *frame);
void link_interrupt(const disco_frame_t *frame)
{
    /* Standard data frames only, of at most 8 bytes: what the bus calls 9 to 15 is 8. */
    (void)disco_queue_put(&received, (const uint8_t *)frame, sizeof(*frame));
}
#else
void link_interrupt(uint8_t byte);
void link_interrupt(uint8_t byte)
{
    (void)disco_queue_put(&received, &byte, 1u);
}
#endif

disco_reset_cause_t port_start(disco_config_t *config)
{
    /* 1. Motor driver off and brake on, before anything else. */
    /* 2. Clock tree from the crystal; a timer of 1 MHz that runs free; a timer interrupt of 1 kHz that wakes port_wait. */
    /* 3. The link, with its receive interrupt or DMA: a serial line at 921 600 Bd, a bus at 500 kbit/s. */
    /* 4. The independent watchdog, 20 to 50 ms, from a clock of its own. */
    /* 5. What is special about this robot. */
    config->ticks_per_rev = 2048u;
    config->max_wheel_speed = 8.0f; /* rad/s */
    config->board_id = 1u;
    /* 6. Why the controller started: read the reset flags, then clear them. A brown-out sets the power-on flag, too. */
    return DISCO_RESET_POWER_ON;
}

uint32_t port_now_us(void)
{
    /* The free timer's count. Of a timer with 16 bits, count its overflows so that no read falls between. */
    return 0u;
}

/* The link: the controller of a bus if compiled with -DDISCO_LINK_CAN; a serial line without it. Delete the other. */
#if defined(DISCO_LINK_CAN)
bool port_receive(disco_frame_t *frame)
{
    return disco_queue_take(&received, (uint8_t *)frame, sizeof(*frame)) == sizeof(*frame);
}

bool port_send(const disco_frame_t *frame)
{
    /* Into a transmit mailbox, lowest identifier first; false if none is free. Restart the controller after bus-off. */
    (void)frame;
    return false;
}
#else
size_t port_receive(uint8_t *bytes, size_t most)
{
    return disco_queue_take(&received, bytes, most);
}

size_t port_send(const uint8_t *bytes, size_t count)
{
    /* Into the transmit buffer or DMA ring, as many as fit; never wait. */
    (void)bytes;
    (void)count;
    return 0u;
}
#endif

uint64_t port_entropy(uint64_t *last)
{
    /* 64 bits of the hardware generator, or a count of starts in flash. 0 is refused by the core: this line has to go. */
    *last = 0u; /* that of the start before, from memory that a reset leaves alone or from flash */
    return 0u;
}

void port_measure(port_measurement_t *measurement)
{
    /* Called once in a cycle. Counts are cumulative and wrap at 2^32; forwards is positive. Cycles that were late come one
     * after the other: a speed is a count over the time that passed, which is not always 1 ms. */
    disco_inputs_t *inputs = &measurement->inputs;
    for (uint8_t side = 0u; side < 2u; side++) {
        inputs->ticks[side] = 0u;
        inputs->wheel_speed[side] = 0.0f; /* rad/s */
        inputs->current[side] = 0.0f;     /* A */
        inputs->temperature[side] = 25.0f;
        inputs->encoder_valid[side] = true; /* false: the board sees that the encoder fails; then ENCODER_MISSING */
    }
    inputs->voltage = 24.0f;
    inputs->estop_button = false; /* wired to the driver's enable line, too */
}

void port_drive(const disco_outputs_t *outputs)
{
    /* Setpoints to the speed loop; enable and brake to their pins. Disabled: whatever the setpoints, no current. */
    (void)outputs;
}

void port_feed_watchdog(void)
{
    /* Feed the independent watchdog, here alone: never from a timer's interrupt, which goes on when the loop hangs. */
}

bool port_load(uint8_t *record)
{
    /* A board without flash to spare: parameters last until the next start. */
    (void)record;
    return false;
}

void port_store(const uint8_t *record)
{
    (void)record;
}

void port_wait(void)
{
    /* WFI, or the operating system's wait for an interrupt. */
}
