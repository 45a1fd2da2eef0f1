#include "authentication.h"

#include <string.h>

#define FRAME (8u)
#define MESSAGE (DISCO_NONCE_LENGTH + 8 + 2 + 8)
#define LOW_BITS (0xFFFFu)

static uint8_t *put(uint8_t *target, uint64_t value, uint8_t bytes)
{
    for (uint8_t i = 0u; i < bytes; i++) {
        target[i] = (uint8_t)(value >> (8u * i));
    }
    return &target[bytes];
}

void disco_authentication_prepare(disco_authentication_t *authentication)
{
    /* 16 bytes where a frame's proof takes 24: a nonce is never the MAC of a frame. */
    uint8_t message[16];
    uint8_t tag[DISCO_AES_BLOCK];
    if (!authentication->required || authentication->prepared) {
        return;
    }
    authentication->draws++;
    (void)put(put(message, authentication->entropy, 8u), authentication->draws, 8u);
    disco_cmac(&authentication->key, message, sizeof(message), tag);
    (void)memcpy(authentication->next_nonce, tag, sizeof(authentication->next_nonce));
    authentication->prepared = true;
}

void disco_authentication_renew(disco_authentication_t *authentication)
{
    disco_authentication_prepare(authentication);
    (void)memcpy(authentication->nonce, authentication->next_nonce, sizeof(authentication->nonce));
    (void)memset(authentication->proofs, 0, sizeof(authentication->proofs));
    authentication->prepared = false;
    authentication->nonce_shown = false;
}

void disco_authentication_init(disco_authentication_t *authentication, bool required, const uint8_t *key,
                               uint64_t entropy)
{
    *authentication = (disco_authentication_t){.required = required, .entropy = entropy};
    disco_cmac_init(&authentication->key, key);
    disco_authentication_renew(authentication);
    disco_authentication_prepare(authentication);
}

void disco_authentication_offer(disco_authentication_t *authentication, disco_proof_index_t index,
                                const uint8_t *data)
{
    disco_proof_t *proof = &authentication->proofs[index];
    proof->offered = (uint16_t)(data[0] | ((uint32_t)data[1] << 8));
    (void)memcpy(proof->mac, &data[2], sizeof(proof->mac));
}

/* The next counter after the last one that has these low bits. */
static uint64_t extended(uint64_t last, uint16_t offered)
{
    return last + 1u + ((offered - (last + 1u)) & LOW_BITS);
}

static uint8_t differing_bits(const uint8_t *a, const uint8_t *b, size_t length)
{
    uint8_t different = 0u;
    for (size_t i = 0u; i < length; i++) {
        different |= (uint8_t)(a[i] ^ b[i]);
    }
    return different;
}

bool disco_authentication_holds(disco_authentication_t *authentication, disco_proof_index_t index, uint32_t can_id,
                                const uint8_t *data)
{
    disco_proof_t *proof = &authentication->proofs[index];
    uint8_t message[MESSAGE];
    uint8_t tag[DISCO_AES_BLOCK];
    if (!authentication->required) {
        return true;
    }
    const uint64_t freshness = extended(proof->freshness, proof->offered);
    (void)memcpy(message, authentication->nonce, sizeof(authentication->nonce));
    (void)memcpy(put(put(&message[DISCO_NONCE_LENGTH], freshness, 8u), can_id, 2u), data, FRAME);
    disco_cmac(&authentication->key, message, sizeof(message), tag);
    const bool holds = differing_bits(tag, proof->mac, sizeof(proof->mac)) == 0u;
    if (holds) {
        proof->freshness = freshness;
    }
    return holds;
}
