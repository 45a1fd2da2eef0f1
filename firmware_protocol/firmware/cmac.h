/* AES-128 (FIPS 197) and the message authentication code made of it (RFC 4493, NIST SP 800-38B). No branch depends on
 * the key or the message; on a processor with a data cache the table lookups may still be timed by whoever shares it.
 */
#ifndef DISCO_CMAC_H
#define DISCO_CMAC_H

#include <stddef.h>
#include <stdint.h>

enum { DISCO_AES_BLOCK = 16, DISCO_AES_ROUND_KEYS = 176 };

typedef struct {
    uint8_t round_keys[DISCO_AES_ROUND_KEYS];
    uint8_t whole[DISCO_AES_BLOCK];  /* subkey of a last block that is full: K1 */
    uint8_t padded[DISCO_AES_BLOCK]; /* of one that is not: K2 */
} disco_cmac_key_t;

/* `bytes`: the key, 16 of them. */
void disco_cmac_init(disco_cmac_key_t *key, const uint8_t *bytes);

/* `tag`: 16 bytes. */
void disco_cmac(const disco_cmac_key_t *key, const uint8_t *message, size_t length, uint8_t *tag);

#endif
