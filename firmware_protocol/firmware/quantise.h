/* Physical values to the integers of the wire, without rounding errors and without doubles. */
#ifndef DISCO_QUANTISE_H
#define DISCO_QUANTISE_H

#include <stdint.h>

/* The raw value nearest to a physical one, within the signal's range; 0 for what is not a number. Exact, in integers: a
 * float has too few bits for it, and a double costs a controller hundreds of instructions. */
int32_t disco_raw(float value, uint32_t per_unit, int32_t minimum, int32_t maximum);
int16_t disco_raw_i16(float value, uint32_t per_unit);
uint16_t disco_raw_u16(float value, uint32_t per_unit);
int8_t disco_raw_i8(float value);

#endif
