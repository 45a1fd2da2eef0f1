/* Proof that a frame comes from who holds the key, now: a truncated AES-CMAC over the robot's nonce, a freshness counter,
 * the identifier and the frame, sent in a frame of its own just before the one that it proves.
 */
#ifndef DISCO_AUTHENTICATION_H
#define DISCO_AUTHENTICATION_H

#include <stdbool.h>
#include <stdint.h>

#include "cmac.h"

enum { DISCO_KEY_LENGTH = 16, DISCO_NONCE_LENGTH = 6, DISCO_MAC_LENGTH = 6 };

typedef enum {
    DISCO_PROOF_WHEEL_COMMAND = 0,
    DISCO_PROOF_HOST_STATE = 1,
    DISCO_PROOF_PARAM_REQUEST = 2,
    DISCO_PROOFS = 3
} disco_proof_index_t;

typedef struct {
    uint64_t freshness; /* of the last frame proved under this nonce */
    uint16_t offered;   /* low bits of the freshness of the next one */
    uint8_t mac[DISCO_MAC_LENGTH];
} disco_proof_t;

typedef struct {
    bool prepared; /* `next_nonce` is drawn */
    bool required;
    bool nonce_shown;
    uint8_t nonce[DISCO_NONCE_LENGTH];
    uint8_t next_nonce[DISCO_NONCE_LENGTH];
    uint64_t entropy;
    uint64_t draws; /* makes each nonce another one */
    disco_proof_t proofs[DISCO_PROOFS];
    disco_cmac_key_t key;
} disco_authentication_t;

/* `entropy` must never be the same twice under one key: from a hardware generator, or a count of starts kept in flash. */
void disco_authentication_init(disco_authentication_t *authentication, bool required, const uint8_t *key,
                               uint64_t entropy);

/* Draws the next nonce, once, where one is required: work for a cycle that has nothing else to do. */
void disco_authentication_prepare(disco_authentication_t *authentication);

/* Puts a new nonce in force: nothing proved so far proves anything any more. */
void disco_authentication_renew(disco_authentication_t *authentication);

/* Takes in the 8 bytes of a MAC frame: freshness, then the MAC. */
void disco_authentication_offer(disco_authentication_t *authentication, disco_proof_index_t index,
                                const uint8_t *data);

/* Whether the MAC offered last proves these 8 bytes; it does so once. Always true where no proof is required. */
bool disco_authentication_holds(disco_authentication_t *authentication, disco_proof_index_t index, uint32_t can_id,
                                const uint8_t *data);

#endif
