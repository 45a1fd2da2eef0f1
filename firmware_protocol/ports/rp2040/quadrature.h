/* Two encoders by PIO: the SDK's example quadrature_encoder, with this face. */
#ifndef DISCO_RP2040_QUADRATURE_H
#define DISCO_RP2040_QUADRATURE_H

#include <stdint.h>

void quadrature_start(uint32_t encoder, uint32_t first_pin);
int32_t quadrature_count(uint32_t encoder);

#endif
