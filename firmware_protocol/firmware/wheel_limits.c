#include "wheel_limits.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#define FRACTION_BITS (23u)
#define EXPONENT_MASK (0xFFu)

bool disco_finite(float value)
{
    uint32_t bits;
    (void)memcpy(&bits, &value, sizeof(bits));
    return ((bits >> FRACTION_BITS) & EXPONENT_MASK) != EXPONENT_MASK;
}

float disco_largest(disco_wheels_t wheels)
{
    if (!disco_finite(wheels.left) || !disco_finite(wheels.right)) {
        return INFINITY;
    }
    return fmaxf(fabsf(wheels.left), fabsf(wheels.right));
}

bool disco_wheels_equal(disco_wheels_t a, disco_wheels_t b)
{
    return (a.left == b.left) && (a.right == b.right);
}

static float within(float value, float bound)
{
    return fminf(fmaxf(value, -bound), bound);
}

disco_wheels_t disco_clamp_speed(disco_wheels_t wanted, float max_speed)
{
    const float largest = disco_largest(wanted);
    disco_wheels_t clamped = wanted;
    if (!disco_finite(largest)) {
        clamped = (disco_wheels_t){0.0f, 0.0f};
    } else if (largest > max_speed) {
        const float factor = max_speed / largest;
        /* The product may round up past the limit. */
        clamped.left = within(wanted.left * factor, max_speed);
        clamped.right = within(wanted.right * factor, max_speed);
    } else {
        /* already within */
    }
    return clamped;
}

disco_wheels_t disco_approach(disco_wheels_t current, disco_wheels_t target, float max_change)
{
    const disco_wheels_t change = {target.left - current.left, target.right - current.right};
    const float largest = disco_largest(change);
    if (largest <= max_change) {
        return target;
    }
    const float factor = max_change / largest;
    return (disco_wheels_t){current.left + (change.left * factor), current.right + (change.right * factor)};
}
