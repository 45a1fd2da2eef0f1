/* A measured pose on its way to the host. */
#ifndef DISCO_POSE_H
#define DISCO_POSE_H

#include <stdbool.h>
#include <stdint.h>

/* A measured pose in the units of its frames. */
typedef struct {
    int32_t x;             /* 0.1 mm */
    int32_t y;             /* 0.1 mm */
    int32_t yaw;           /* 0.1 mrad */
    uint16_t position_std; /* mm */
    uint16_t yaw_std;      /* mrad */
    bool valid;
} disco_pose_t;

/* The same from metres and radians; not valid where a value is not finite or a deviation below zero. A float tells
 * 0.1 mm apart up to 800 m: whoever knows a pose better makes the struct himself. */
disco_pose_t disco_pose(float x, float y, float yaw, float position_std, float yaw_std);

#endif
