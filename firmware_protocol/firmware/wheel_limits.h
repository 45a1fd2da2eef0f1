/* Hard limits on the pair of wheel speeds; both wheels are always changed by one factor, so that curvature is kept. */
#ifndef DISCO_WHEEL_LIMITS_H
#define DISCO_WHEEL_LIMITS_H

#include <stdbool.h>

/* Whether it is a number within a float's range, asked of its bits: without an FPU, each of the C library's comparisons is
 * a call. */
bool disco_finite(float value);

typedef struct {
    float left;  /* rad/s */
    float right; /* rad/s */
} disco_wheels_t;

/* Scales both wheels so that neither is faster than the limit; a value that is not finite gives standstill. */
disco_wheels_t disco_clamp_speed(disco_wheels_t wanted, float max_speed);

/* Moves from `current` towards `target` so that neither wheel changes by more than `max_change`. */
disco_wheels_t disco_approach(disco_wheels_t current, disco_wheels_t target, float max_change);

/* The larger of the two magnitudes; not finite if either is not. */
float disco_largest(disco_wheels_t wheels);

bool disco_wheels_equal(disco_wheels_t a, disco_wheels_t b);

#endif
