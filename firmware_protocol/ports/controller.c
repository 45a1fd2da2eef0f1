/* The controller's main loop, the same on every board: bytes or frames to the core, a cycle when it is due, what the core
 * says to the link. The board's part is port.h. */
#include "port.h"

#include <string.h>

#if defined(DISCO_LINK_SLCAN)
#include "slcan.h"
#elif !defined(DISCO_LINK_CAN)
#include "serial_framing.h"
#endif

/* Cycles that the board has missed by more than this are not caught up. */
#define MOST_BEHIND_US (20000u)

static disco_firmware_t core;
static port_measurement_t measurement;
static disco_outputs_t outputs;
static uint64_t now_us;
static uint32_t last_us;
static uint8_t kept[DISCO_RECORD_LENGTH]; /* the record of the parameters, as it was stored last */

/* The core's 64-bit clock from the counter's 32 bits; called far more often than the counter wraps. */
static uint64_t clock_us(void)
{
    const uint32_t read_us = port_now_us();
    now_us += (uint32_t)(read_us - last_us);
    last_us = read_us;
    return now_us;
}

#if defined(DISCO_LINK_CAN)

static void start_link(void) {}

/* Whether there may be more: a line that never falls silent must not hold up the cycle, so no turn takes all. */
static bool receive(void)
{
    disco_frame_t frame;
    const bool came = port_receive(&frame);
    if (came) {
        disco_firmware_receive(&core, clock_us(), frame.can_id, frame.data, frame.length);
    }
    return came;
}

static void send(void)
{
    static disco_frame_t waiting;
    static bool is_waiting;
    while (is_waiting || disco_firmware_pop(&core, &waiting)) {
        is_waiting = !port_send(&waiting);
        if (is_waiting) {
            return;
        }
    }
}

#else

#if defined(DISCO_LINK_SLCAN)
enum { ENCODED = DISCO_SLCAN_ENCODED };
static disco_slcan_t line;
#else
enum { ENCODED = DISCO_SERIAL_ENCODED };
static disco_serial_decoder_t line;
#endif

static struct {
    uint8_t bytes[ENCODED];
    uint8_t count;
    uint8_t sent;
} outgoing;

static void start_link(void)
{
#if defined(DISCO_LINK_SLCAN)
    disco_slcan_init(&line);
#else
    disco_serial_init(&line);
#endif
}

static bool completes(uint8_t byte, disco_frame_t *frame)
{
#if defined(DISCO_LINK_SLCAN)
    return disco_slcan_feed(&line, byte, frame);
#else
    return disco_serial_feed(&line, byte, frame);
#endif
}

/* Whether there may be more: a line that never falls silent must not hold up the cycle, so no turn takes all. */
static bool receive(void)
{
    uint8_t bytes[64];
    disco_frame_t frame;
    const size_t count = port_receive(bytes, sizeof(bytes));
    for (size_t i = 0u; i < count; i++) {
        if (completes(bytes[i], &frame)) {
            disco_firmware_receive(&core, clock_us(), frame.can_id, frame.data, frame.length);
        }
    }
    return count == sizeof(bytes);
}

static bool next_to_send(void)
{
    disco_frame_t frame;
#if defined(DISCO_LINK_SLCAN)
    outgoing.count = disco_slcan_reply(&line, outgoing.bytes);
    if (outgoing.count > 0u) {
        return true;
    }
#endif
    if (!disco_firmware_pop(&core, &frame)) {
        return false;
    }
#if defined(DISCO_LINK_SLCAN)
    outgoing.count = disco_slcan_encode(&line, &frame, outgoing.bytes);
#else
    outgoing.count = disco_serial_encode(&frame, outgoing.bytes);
#endif
    return true;
}

static void send(void)
{
    while ((outgoing.sent < outgoing.count) || next_to_send()) {
        outgoing.sent += (uint8_t)port_send(&outgoing.bytes[outgoing.sent], (size_t)outgoing.count - outgoing.sent);
        if (outgoing.sent < outgoing.count) {
            return;
        }
        outgoing.sent = 0u;
        outgoing.count = 0u;
    }
}

#endif

static void measure(void)
{
#if defined(DISCO_PLANT_LINE)
    plant_line_measure(&measurement);
#else
    port_measure(&measurement);
#endif
}

static void drive(void)
{
#if defined(DISCO_PLANT_LINE)
    plant_line_drive(&outputs, &core.config);
#else
    port_drive(&outputs);
#endif
}

/* Flash wears out: what is written again as it was is not kept again. */
static void keep_parameters(void)
{
    static uint32_t written;
    uint8_t record[DISCO_RECORD_LENGTH];
    if (core.parameter_writes != written) {
        written = core.parameter_writes;
        disco_record_pack(&core.config, record);
        if (memcmp(record, kept, sizeof(record)) != 0) {
            (void)memcpy(kept, record, sizeof(record));
            port_store(record);
        }
    }
}

static void cycle(void)
{
    measure();
    const uint64_t cycle_us = clock_us();
    if (measurement.posed) {
        disco_firmware_pose(&core, &measurement.pose, cycle_us - (uint32_t)(last_us - measurement.pose_us));
        measurement.posed = false;
    }
    disco_firmware_step(&core, cycle_us, &measurement.inputs, &outputs);
    drive();
    keep_parameters();
}

int main(void)
{
    uint64_t last_entropy = 0u;
    disco_config_t config = disco_config_default(2048u, 8.0f);
    measurement.inputs.reset_cause = (uint8_t)port_start(&config);
    if (port_load(kept)) {
        (void)disco_record_unpack(kept, &config);
    }
#if defined(DISCO_PLANT_LINE)
    config.board_id |= DISCO_BOARD_VIRTUAL;
#endif
    const uint64_t entropy = port_entropy(&last_entropy);
    disco_firmware_init(&core, &config, entropy, last_entropy);
    start_link();
    measurement.inputs.voltage = 24.0f;
    last_us = port_now_us();
    uint32_t due_us = last_us;
    for (;;) {
        const bool more = receive();
        const int32_t behind_us = (int32_t)(port_now_us() - due_us);
        if (behind_us >= 0) {
            due_us += (behind_us < (int32_t)MOST_BEHIND_US) ? config.cycle_us : ((uint32_t)behind_us + config.cycle_us);
            cycle();
            send();
            port_feed_watchdog();
        } else {
            send();
            if (!more) {
                port_wait();
            }
        }
    }
}
