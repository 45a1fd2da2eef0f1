/* End-to-end protection of a frame: CRC-8 with a data id, a 4-bit counter, and the receiver's judgement of both. */
#ifndef DISCO_E2E_H
#define DISCO_E2E_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef enum {
    DISCO_E2E_INITIAL = 0,
    DISCO_E2E_OK = 1,
    DISCO_E2E_OK_SOME_LOST = 2,
    DISCO_E2E_REPEATED = 3,
    DISCO_E2E_WRONG_SEQUENCE = 4,
    DISCO_E2E_WRONG_CRC = 5
} disco_e2e_status_t;

typedef struct {
    uint64_t last_good_us;
    uint32_t timeout_us;
    uint8_t last_counter;
    uint8_t good;
    uint8_t score;
    bool started;
    bool qualified;
} disco_e2e_receiver_t;

/* CRC-8H2F (polynomial 0x2F, initial value and final xor 0xFF); the check value of "123456789" is 0xDF. */
uint8_t disco_crc8(const uint8_t *data, size_t length);

/* CRC-16/CCITT-FALSE; the check value of "123456789" is 0x29B1. */
uint16_t disco_crc16(const uint8_t *data, size_t length);

/* The CRC of an 8-byte frame: over bytes 1 to 7, then the data id, little-endian. */
uint8_t disco_e2e_crc(const uint8_t *frame, uint16_t data_id);

/* What a host must answer to arm. */
uint16_t disco_challenge_answer(uint16_t challenge, uint8_t session, uint32_t dbc_hash);

void disco_e2e_init(disco_e2e_receiver_t *receiver, uint32_t timeout_us);

/* Takes in one received frame; it may be used only if the result is OK or OK_SOME_LOST and the sender is qualified. */
disco_e2e_status_t disco_e2e_check(disco_e2e_receiver_t *receiver, uint8_t counter, bool crc_ok, uint64_t now_us);

/* Disqualifies the sender if nothing good came for the timeout; returns whether it is qualified. */
bool disco_e2e_expire(disco_e2e_receiver_t *receiver, uint64_t now_us);

#endif
