#include "cmac.h"

#define ROUNDS (10u)
#define BLOCK ((size_t)DISCO_AES_BLOCK)
#define COLUMN (4u)
#define HIGH_BIT (0x80u)

/* FIPS 197, figure 7. */
static const uint8_t s_box[256] = {
    0x63u, 0x7Cu, 0x77u, 0x7Bu, 0xF2u, 0x6Bu, 0x6Fu, 0xC5u, 0x30u, 0x01u, 0x67u, 0x2Bu, 0xFEu, 0xD7u, 0xABu, 0x76u,
    0xCAu, 0x82u, 0xC9u, 0x7Du, 0xFAu, 0x59u, 0x47u, 0xF0u, 0xADu, 0xD4u, 0xA2u, 0xAFu, 0x9Cu, 0xA4u, 0x72u, 0xC0u,
    0xB7u, 0xFDu, 0x93u, 0x26u, 0x36u, 0x3Fu, 0xF7u, 0xCCu, 0x34u, 0xA5u, 0xE5u, 0xF1u, 0x71u, 0xD8u, 0x31u, 0x15u,
    0x04u, 0xC7u, 0x23u, 0xC3u, 0x18u, 0x96u, 0x05u, 0x9Au, 0x07u, 0x12u, 0x80u, 0xE2u, 0xEBu, 0x27u, 0xB2u, 0x75u,
    0x09u, 0x83u, 0x2Cu, 0x1Au, 0x1Bu, 0x6Eu, 0x5Au, 0xA0u, 0x52u, 0x3Bu, 0xD6u, 0xB3u, 0x29u, 0xE3u, 0x2Fu, 0x84u,
    0x53u, 0xD1u, 0x00u, 0xEDu, 0x20u, 0xFCu, 0xB1u, 0x5Bu, 0x6Au, 0xCBu, 0xBEu, 0x39u, 0x4Au, 0x4Cu, 0x58u, 0xCFu,
    0xD0u, 0xEFu, 0xAAu, 0xFBu, 0x43u, 0x4Du, 0x33u, 0x85u, 0x45u, 0xF9u, 0x02u, 0x7Fu, 0x50u, 0x3Cu, 0x9Fu, 0xA8u,
    0x51u, 0xA3u, 0x40u, 0x8Fu, 0x92u, 0x9Du, 0x38u, 0xF5u, 0xBCu, 0xB6u, 0xDAu, 0x21u, 0x10u, 0xFFu, 0xF3u, 0xD2u,
    0xCDu, 0x0Cu, 0x13u, 0xECu, 0x5Fu, 0x97u, 0x44u, 0x17u, 0xC4u, 0xA7u, 0x7Eu, 0x3Du, 0x64u, 0x5Du, 0x19u, 0x73u,
    0x60u, 0x81u, 0x4Fu, 0xDCu, 0x22u, 0x2Au, 0x90u, 0x88u, 0x46u, 0xEEu, 0xB8u, 0x14u, 0xDEu, 0x5Eu, 0x0Bu, 0xDBu,
    0xE0u, 0x32u, 0x3Au, 0x0Au, 0x49u, 0x06u, 0x24u, 0x5Cu, 0xC2u, 0xD3u, 0xACu, 0x62u, 0x91u, 0x95u, 0xE4u, 0x79u,
    0xE7u, 0xC8u, 0x37u, 0x6Du, 0x8Du, 0xD5u, 0x4Eu, 0xA9u, 0x6Cu, 0x56u, 0xF4u, 0xEAu, 0x65u, 0x7Au, 0xAEu, 0x08u,
    0xBAu, 0x78u, 0x25u, 0x2Eu, 0x1Cu, 0xA6u, 0xB4u, 0xC6u, 0xE8u, 0xDDu, 0x74u, 0x1Fu, 0x4Bu, 0xBDu, 0x8Bu, 0x8Au,
    0x70u, 0x3Eu, 0xB5u, 0x66u, 0x48u, 0x03u, 0xF6u, 0x0Eu, 0x61u, 0x35u, 0x57u, 0xB9u, 0x86u, 0xC1u, 0x1Du, 0x9Eu,
    0xE1u, 0xF8u, 0x98u, 0x11u, 0x69u, 0xD9u, 0x8Eu, 0x94u, 0x9Bu, 0x1Eu, 0x87u, 0xE9u, 0xCEu, 0x55u, 0x28u, 0xDFu,
    0x8Cu, 0xA1u, 0x89u, 0x0Du, 0xBFu, 0xE6u, 0x42u, 0x68u, 0x41u, 0x99u, 0x2Du, 0x0Fu, 0xB0u, 0x54u, 0xBBu, 0x16u,
};

/* Multiplication by x in GF(2^8), without a branch on secret data. */
static uint8_t doubled(uint8_t value)
{
    return (uint8_t)(((uint32_t)value << 1) ^ (((uint32_t)value >> 7) * 0x1Bu));
}

static void xor_block(uint8_t *target, const uint8_t *other)
{
    for (size_t i = 0u; i < BLOCK; i++) {
        target[i] ^= other[i];
    }
}

/* FIPS 197, section 5.2. */
static void expand(uint8_t *round_keys, const uint8_t *key)
{
    uint8_t constant = 1u;
    for (size_t i = 0u; i < BLOCK; i++) {
        round_keys[i] = key[i];
    }
    for (size_t i = BLOCK; i < (size_t)DISCO_AES_ROUND_KEYS; i += COLUMN) {
        const uint8_t *last = &round_keys[i - COLUMN];
        uint8_t word[COLUMN] = {last[0], last[1], last[2], last[3]};
        if ((i % BLOCK) == 0u) {
            word[0] = (uint8_t)(s_box[last[1]] ^ constant);
            word[1] = s_box[last[2]];
            word[2] = s_box[last[3]];
            word[3] = s_box[last[0]];
            constant = doubled(constant);
        }
        for (size_t j = 0u; j < COLUMN; j++) {
            round_keys[i + j] = (uint8_t)(round_keys[(i + j) - BLOCK] ^ word[j]);
        }
    }
}

/* ShiftRows: row r of the state, kept in columns, moves left by r. */
static const uint8_t shifted_from[DISCO_AES_BLOCK] = {0u, 5u, 10u, 15u, 4u, 9u, 14u, 3u, 8u, 13u, 2u, 7u, 12u, 1u, 6u, 11u};

/* SubBytes and ShiftRows. */
static void substitute_and_shift(uint8_t *state)
{
    uint8_t before[DISCO_AES_BLOCK];
    for (size_t i = 0u; i < BLOCK; i++) {
        before[i] = state[i];
    }
    for (size_t i = 0u; i < BLOCK; i++) {
        state[i] = s_box[before[shifted_from[i]]];
    }
}

static void mix_columns(uint8_t *state)
{
    for (size_t i = 0u; i < BLOCK; i += COLUMN) {
        uint8_t *column = &state[i];
        const uint8_t first = column[0];
        const uint8_t all = (uint8_t)(column[0] ^ column[1] ^ column[2] ^ column[3]);
        column[0] ^= (uint8_t)(all ^ doubled((uint8_t)(column[0] ^ column[1])));
        column[1] ^= (uint8_t)(all ^ doubled((uint8_t)(column[1] ^ column[2])));
        column[2] ^= (uint8_t)(all ^ doubled((uint8_t)(column[2] ^ column[3])));
        column[3] ^= (uint8_t)(all ^ doubled((uint8_t)(column[3] ^ first)));
    }
}

static void encrypt(const disco_cmac_key_t *key, uint8_t *state)
{
    xor_block(state, key->round_keys);
    for (size_t round = 1u; round < ROUNDS; round++) {
        substitute_and_shift(state);
        mix_columns(state);
        xor_block(state, &key->round_keys[BLOCK * round]);
    }
    substitute_and_shift(state);
    xor_block(state, &key->round_keys[BLOCK * ROUNDS]);
}

/* Multiplication by x in GF(2^128), RFC 4493 section 2.3. */
static void double_block(uint8_t *target, const uint8_t *block)
{
    for (size_t i = 0u; i < (BLOCK - 1u); i++) {
        target[i] = (uint8_t)(((uint32_t)block[i] << 1) | ((uint32_t)block[i + 1u] >> 7));
    }
    target[BLOCK - 1u] = (uint8_t)(((uint32_t)block[BLOCK - 1u] << 1) ^ (((uint32_t)block[0] >> 7) * 0x87u));
}

void disco_cmac_init(disco_cmac_key_t *key, const uint8_t *bytes)
{
    uint8_t zero[DISCO_AES_BLOCK] = {0u};
    expand(key->round_keys, bytes);
    encrypt(key, zero);
    double_block(key->whole, zero);
    double_block(key->padded, key->whole);
}

void disco_cmac(const disco_cmac_key_t *key, const uint8_t *message, size_t length, uint8_t *tag)
{
    size_t left = length;
    const uint8_t *from = message;
    for (size_t i = 0u; i < BLOCK; i++) {
        tag[i] = 0u;
    }
    while (left > BLOCK) {
        xor_block(tag, from);
        encrypt(key, tag);
        from = &from[BLOCK];
        left -= BLOCK;
    }
    for (size_t i = 0u; i < left; i++) {
        tag[i] ^= from[i];
    }
    if (left == BLOCK) {
        xor_block(tag, key->whole);
    } else {
        tag[left] ^= HIGH_BIT;
        xor_block(tag, key->padded);
    }
    encrypt(key, tag);
}
