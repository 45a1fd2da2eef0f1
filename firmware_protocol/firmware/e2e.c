#include "e2e.h"

#define COUNTER_MASK (0x0Fu)
#define QUALIFY_AFTER (3u)
#define DISQUALIFY_AT (5u)
#define MAX_DELTA (3u)

/* What four bits shifted out of the CRC-8 add to it. */
static const uint8_t crc8_of_nibble[16] = {0x00u, 0x2Fu, 0x5Eu, 0x71u, 0xBCu, 0x93u, 0xE2u, 0xCDu,
                                           0x57u, 0x78u, 0x09u, 0x26u, 0xEBu, 0xC4u, 0xB5u, 0x9Au};

static uint8_t crc8_byte(uint8_t crc, uint8_t byte)
{
    const uint8_t with = crc ^ byte;
    const uint8_t high = (uint8_t)(((uint32_t)with << 4) ^ crc8_of_nibble[with >> 4]);
    return (uint8_t)(((uint32_t)high << 4) ^ crc8_of_nibble[high >> 4]);
}

uint8_t disco_crc8(const uint8_t *data, size_t length)
{
    uint8_t crc = 0xFFu;
    for (size_t i = 0u; i < length; i++) {
        crc = crc8_byte(crc, data[i]);
    }
    return (uint8_t)(crc ^ 0xFFu);
}

uint16_t disco_crc16(const uint8_t *data, size_t length)
{
    uint16_t crc = 0xFFFFu;
    for (size_t i = 0u; i < length; i++) {
        crc = (uint16_t)(crc ^ ((uint32_t)data[i] << 8));
        for (uint8_t bit = 0u; bit < 8u; bit++) {
            crc = (uint16_t)(((crc & 0x8000u) != 0u) ? (((uint32_t)crc << 1) ^ 0x1021u) : ((uint32_t)crc << 1));
        }
    }
    return crc;
}

uint8_t disco_e2e_crc(const uint8_t *frame, uint16_t data_id)
{
    uint8_t crc = 0xFFu;
    for (uint8_t i = 1u; i < 8u; i++) {
        crc = crc8_byte(crc, frame[i]);
    }
    crc = crc8_byte(crc8_byte(crc, (uint8_t)(data_id & 0xFFu)), (uint8_t)(data_id >> 8));
    return (uint8_t)(crc ^ 0xFFu);
}

uint16_t disco_challenge_answer(uint16_t challenge, uint8_t session, uint32_t dbc_hash)
{
    const uint8_t proof[7] = {
        (uint8_t)(challenge & 0xFFu),        (uint8_t)(challenge >> 8),         session,
        (uint8_t)(dbc_hash & 0xFFu),         (uint8_t)((dbc_hash >> 8) & 0xFFu), (uint8_t)((dbc_hash >> 16) & 0xFFu),
        (uint8_t)((dbc_hash >> 24) & 0xFFu),
    };
    return disco_crc16(proof, sizeof(proof));
}

void disco_e2e_init(disco_e2e_receiver_t *receiver, uint32_t timeout_us)
{
    *receiver = (disco_e2e_receiver_t){.timeout_us = timeout_us};
}

bool disco_e2e_expire(disco_e2e_receiver_t *receiver, uint64_t now_us)
{
    if (receiver->started && ((now_us - receiver->last_good_us) > receiver->timeout_us)) {
        disco_e2e_init(receiver, receiver->timeout_us);
    }
    return receiver->qualified;
}

static disco_e2e_status_t bad(disco_e2e_receiver_t *receiver, disco_e2e_status_t status)
{
    receiver->good = 0u;
    if (receiver->score < DISQUALIFY_AT) {
        receiver->score++;
    }
    if (receiver->score == DISQUALIFY_AT) {
        receiver->qualified = false;
    }
    return status;
}

disco_e2e_status_t disco_e2e_check(disco_e2e_receiver_t *receiver, uint8_t counter, bool crc_ok, uint64_t now_us)
{
    (void)disco_e2e_expire(receiver, now_us);
    if (!crc_ok) {
        return bad(receiver, DISCO_E2E_WRONG_CRC);
    }
    const uint8_t delta = (uint8_t)(((uint32_t)counter - receiver->last_counter) & COUNTER_MASK);
    receiver->last_counter = counter;
    if (!receiver->started) {
        receiver->started = true;
        receiver->last_good_us = now_us;
        return DISCO_E2E_INITIAL;
    }
    if (delta == 0u) {
        return bad(receiver, DISCO_E2E_REPEATED);
    }
    if (delta > MAX_DELTA) {
        return bad(receiver, DISCO_E2E_WRONG_SEQUENCE);
    }
    receiver->last_good_us = now_us;
    if (receiver->good < QUALIFY_AFTER) {
        receiver->good++;
    }
    if (receiver->score > 0u) {
        receiver->score--;
    }
    if ((receiver->good == QUALIFY_AFTER) && !receiver->qualified) {
        receiver->qualified = true;
        receiver->score = 0u;
    }
    return (delta == 1u) ? DISCO_E2E_OK : DISCO_E2E_OK_SOME_LOST;
}
