#include "quantise.h"

#include <math.h>
#include <stdbool.h>
#include <string.h>

/* A float is (fraction + implicit bit) * 2^(exponent - INTEGER_EXPONENT); from that exponent on, all are out of range. */
#define FRACTION_BITS (23u)
#define FRACTION_MASK (0x007FFFFFu)
#define IMPLICIT_BIT (0x00800000u)
#define EXPONENT_MASK (0xFFu)
#define INTEGER_EXPONENT (150u)
/* 24 bits by 10000 are 38: further down, nothing is left of them. */
#define SMALLEST_SHIFT (39u)

int32_t disco_raw(float value, uint32_t per_unit, int32_t minimum, int32_t maximum)
{
    uint32_t bits;
    (void)memcpy(&bits, &value, sizeof(bits));
    const bool negative = (bits >> 31) != 0u;
    const uint32_t exponent = (bits >> FRACTION_BITS) & EXPONENT_MASK;
    const uint32_t shift = INTEGER_EXPONENT - exponent;
    int32_t result;
    if (isnan(value)) {
        result = 0;
    } else if (exponent >= INTEGER_EXPONENT) {
        result = negative ? minimum : maximum;
    } else if (shift > SMALLEST_SHIFT) {
        result = 0;
    } else {
        /* Halves go up, so that those of negative values go towards zero. */
        const uint64_t half = UINT64_C(1) << (shift - 1u);
        const uint64_t magnitude = (uint64_t)((bits & FRACTION_MASK) | IMPLICIT_BIT) * per_unit;
        const uint64_t rounded = ((magnitude + half) - (negative ? 1u : 0u)) >> shift;
        const uint32_t bound = (uint32_t)(negative ? -minimum : maximum);
        const int32_t limited = (int32_t)((rounded < bound) ? (uint32_t)rounded : bound);
        result = negative ? -limited : limited;
    }
    return result;
}

int16_t disco_raw_i16(float value, uint32_t per_unit)
{
    return (int16_t)disco_raw(value, per_unit, INT16_MIN, INT16_MAX);
}

uint16_t disco_raw_u16(float value, uint32_t per_unit)
{
    return (uint16_t)disco_raw(value, per_unit, 0, UINT16_MAX);
}

int8_t disco_raw_i8(float value)
{
    return (int8_t)disco_raw(value, 1u, INT8_MIN, INT8_MAX);
}
