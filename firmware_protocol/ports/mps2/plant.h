/* The robot around an emulated board: two wheels with motors, a skid-steer body, a pose sensor. */
#ifndef DISCO_MPS2_PLANT_H
#define DISCO_MPS2_PLANT_H

#include <stdbool.h>
#include <stdint.h>

#include "port.h"

typedef struct {
    float speed[2]; /* rad/s; left, right */
    float angle[2]; /* rad, less whole turns */
    uint32_t turns[2];
    float current[2]; /* A */
    float uneven[2];  /* part of the speed by which a wheel runs too fast */
    float slip[3];    /* m/s forward and left, rad/s */
    float x, y, yaw;  /* m, rad: the tracked point */
    uint32_t noise;
} plant_t;

/* At rest at the place where the circle of the demonstration begins. */
void plant_init(plant_t *plant);

/* One step of `dt` seconds under these outputs. */
void plant_step(plant_t *plant, const disco_outputs_t *outputs, float dt);

/* What the board's encoders and current sensors read. */
void plant_read(const plant_t *plant, disco_inputs_t *inputs);

/* What the pose sensor reads, with its noise. */
disco_pose_t plant_pose(plant_t *plant);

#endif
