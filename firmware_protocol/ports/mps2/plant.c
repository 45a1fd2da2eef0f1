#include "plant.h"

#include <math.h>

/* Those of `disco-hw sim` (sim/plant_parameters.py): the posterior mean of the paper's skid-steer robot, whose motors follow
 * their setpoints at once. */
#define RADIUS_M (0.061f)
#define AXIAL_DISTANCE_M (0.415f)
#define X_ICR_M (0.238f)
#define BRAKE_S (0.04f)
#define COAST_S (1.5f)
#define INERTIA (0.03f)
#define DRY_FRICTION_NM (0.15f)
#define NM_PER_A (0.25f)
#define STANDING_RAD_S (0.02f)
#define TICKS_PER_TURN (2048.0f)
#define TWO_PI (6.2831853f)
#define POSITION_STD_M (0.005f)
#define YAW_STD_RAD (0.0087f)
#define WHEEL_STD (0.015f)
#define WHEEL_CORRELATION_S (0.15f)
#define SLIP_CORRELATION_S (0.3f)
#define SLIP_ONSET_M_S (0.05f)
static const float slip_std[3] = {0.005f, 0.004f, 0.018f};

static float uniform(plant_t *plant)
{
    plant->noise ^= plant->noise << 13;
    plant->noise ^= plant->noise >> 17;
    plant->noise ^= plant->noise << 5;
    return (float)(plant->noise >> 8) * (1.0f / 16777216.0f);
}

/* Of mean 0 and variance 1, by the sum of twelve. */
static float normal(plant_t *plant)
{
    float sum = -6.0f;
    for (int i = 0; i < 12; i++) {
        sum += uniform(plant);
    }
    return sum;
}

void plant_init(plant_t *plant)
{
    *plant = (plant_t){.x = 0.75f, .yaw = 1.5707963f, .noise = 2463534242u};
}

/* One step of an Ornstein-Uhlenbeck process. */
static void wander(plant_t *plant, float *value, float std, float part)
{
    *value += (-*value * part) + (std * sqrtf(2.0f * part) * normal(plant));
}

static void turn_wheel(plant_t *plant, int side, float setpoint, const disco_outputs_t *outputs, float dt)
{
    const float before = plant->speed[side];
    float speed;
    if (outputs->driver_enabled) {
        if (setpoint != 0.0f) {
            wander(plant, &plant->uneven[side], WHEEL_STD, dt / WHEEL_CORRELATION_S);
        }
        speed = setpoint * (1.0f + plant->uneven[side]);
    } else {
        speed = before - (before * (dt / (outputs->brake ? BRAKE_S : COAST_S)));
        if (fabsf(speed) < STANDING_RAD_S) {
            speed = 0.0f;
        }
    }
    const float change = speed - before;
    plant->speed[side] = speed;
    plant->angle[side] += 0.5f * (before + speed) * dt;
    if (plant->angle[side] >= TWO_PI) {
        plant->angle[side] -= TWO_PI;
        plant->turns[side]++;
    } else if (plant->angle[side] < 0.0f) {
        plant->angle[side] += TWO_PI;
        plant->turns[side]--;
    }
    const float torque = (speed != 0.0f) ? ((INERTIA * fabsf(change) / dt) + DRY_FRICTION_NM) : 0.0f;
    plant->current[side] = outputs->driver_enabled ? (torque / NM_PER_A) : 0.0f;
}

void plant_step(plant_t *plant, const disco_outputs_t *outputs, float dt)
{
    turn_wheel(plant, 0, outputs->left_setpoint, outputs, dt);
    turn_wheel(plant, 1, outputs->right_setpoint, outputs, dt);
    const float left = plant->speed[0] * RADIUS_M;
    const float right = plant->speed[1] * RADIUS_M;
    const float fastest = fmaxf(fabsf(left), fabsf(right));
    if (fastest == 0.0f) {
        return;
    }
    const float slipping = fminf(fastest / SLIP_ONSET_M_S, 1.0f);
    for (int i = 0; i < 3; i++) {
        wander(plant, &plant->slip[i], slip_std[i], dt / SLIP_CORRELATION_S);
    }
    const float turning = (right - left) / AXIAL_DISTANCE_M;
    const float forward = (0.5f * (left + right)) + (slipping * plant->slip[0]);
    const float sideways = (-X_ICR_M * turning) + (slipping * plant->slip[1]);
    const float yaw_rate = turning + (slipping * plant->slip[2]);
    const float heading = plant->yaw + (0.5f * yaw_rate * dt);
    const float cosine = cosf(heading);
    const float sine = sinf(heading);
    plant->x += ((cosine * forward) - (sine * sideways)) * dt;
    plant->y += ((sine * forward) + (cosine * sideways)) * dt;
    plant->yaw = remainderf(plant->yaw + (yaw_rate * dt), TWO_PI);
}

void plant_read(const plant_t *plant, disco_inputs_t *inputs)
{
    for (int side = 0; side < 2; side++) {
        const float part = plant->angle[side] * (TICKS_PER_TURN / TWO_PI);
        inputs->ticks[side] = (plant->turns[side] * (uint32_t)TICKS_PER_TURN) + (uint32_t)part;
        inputs->wheel_speed[side] = plant->speed[side];
        inputs->current[side] = plant->current[side];
        inputs->temperature[side] = 25.0f;
        inputs->encoder_valid[side] = true;
    }
    inputs->battery_current = plant->current[0] + plant->current[1];
    inputs->battery_temperature = 25.0f;
}

disco_pose_t plant_pose(plant_t *plant)
{
    const float x = plant->x + (POSITION_STD_M * normal(plant));
    const float y = plant->y + (POSITION_STD_M * normal(plant));
    const float yaw = remainderf(plant->yaw + (YAW_STD_RAD * normal(plant)), TWO_PI);
    return disco_pose(x, y, yaw, POSITION_STD_M, YAW_STD_RAD);
}
