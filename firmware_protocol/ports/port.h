/* What a board must do for the controller: eleven functions, and two more for a board on a desk that drives a virtual robot.
 *
 * Concurrency: controller.c calls all of them from the main loop, one after the other, and nothing else may call
 * the core. An interrupt may call disco_queue_put or disco_queue_take (queue.h), each queue from one side only, and
 * read what port_drive stored. Never from an interrupt: disco_firmware_*, disco_serial_*, disco_slcan_*.
 */
#ifndef DISCO_PORT_H
#define DISCO_PORT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "firmware.h"
#include "parameter_record.h"

typedef struct {
    disco_inputs_t inputs;
    disco_pose_t pose;
    uint32_t pose_us; /* port_now_us() when the pose was true */
    bool posed;       /* there is a pose that was not told yet */
} port_measurement_t;

/* Starts clocks, timers, pins, the link and the hardware watchdog, and says what is special about this robot. Returns why
 * the controller started. */
disco_reset_cause_t port_start(disco_config_t *config);

/* Microseconds from a timer that runs free (never from counted interrupts); wraps at 2^32. */
uint32_t port_now_us(void);

#if defined(DISCO_LINK_CAN)
/* Takes the oldest frame that has come over the bus; false: there is none. */
bool port_receive(disco_frame_t *frame);

/* Gives a frame to the controller of the bus; false: it has no room, try again. */
bool port_send(const disco_frame_t *frame);
#else
/* Copies up to `most` bytes that have come over the serial line; returns how many. Does not wait. */
size_t port_receive(uint8_t *bytes, size_t most);

/* Sends bytes over the serial line, as many as fit now; returns how many. Does not wait. */
size_t port_send(const uint8_t *bytes, size_t count);
#endif

/* A number that is another one at each start, and in `last` that of the start before (0: not known). */
uint64_t port_entropy(uint64_t *last);

/* Fills in what is measured now; what the board does not measure stays as it is given. */
void port_measure(port_measurement_t *measurement);

/* Takes over setpoints, driver enable and brake. */
void port_drive(const disco_outputs_t *outputs);

/* Feeds the independent hardware watchdog: called after each cycle, and nowhere else. */
void port_feed_watchdog(void);

/* Reads (false: there is none) and keeps the parameters that a host has written, DISCO_RECORD_LENGTH bytes. Kept only while
 * disarmed; must not take longer than the hardware watchdog allows. */
bool port_load(uint8_t *record);
void port_store(const uint8_t *record);

/* Sleeps until the next interrupt; may return at once. A timer wakes it at least once in a cycle. */
void port_wait(void);

#if defined(DISCO_PLANT_LINE)
/* For a board on a desk (docs/port.md), never for one in a robot: the bytes of a second serial line, over which a virtual
 * robot takes the place of wheels. port_measure and port_drive are then left out, so that the driver stays as port_start
 * has it, off; and the board tells its host that it is none of a real robot. Neither waits. */
size_t port_plant_receive(uint8_t *bytes, size_t most);
size_t port_plant_send(const uint8_t *bytes, size_t count);

/* Their user, plant_line.c, in the place of the other two. */
void plant_line_measure(port_measurement_t *measurement);
void plant_line_drive(const disco_outputs_t *outputs, const disco_config_t *config);
#define DISCO_BOARD_VIRTUAL (0x8000u) /* in BUILD.board_id */
#endif

#endif
