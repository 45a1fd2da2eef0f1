#include "pose.h"

#include "protocol_constants.h"
#include "quantise.h"
#include "wheel_limits.h"

#define BEYOND_POSITION (0x800000)
#define BEYOND_YAW (0x8000)

disco_pose_t disco_pose(float x, float y, float yaw, float position_std, float yaw_std)
{
    const bool known = disco_finite(x) && disco_finite(y) && disco_finite(yaw) && (position_std >= 0.0f) && (yaw_std >= 0.0f);
    return (disco_pose_t){
        .valid = known,
        .x = disco_raw(x, DISCO_POSE_POSITION_X_PER_UNIT, -BEYOND_POSITION, BEYOND_POSITION),
        .y = disco_raw(y, DISCO_POSE_POSITION_Y_PER_UNIT, -BEYOND_POSITION, BEYOND_POSITION),
        .yaw = disco_raw(yaw, DISCO_POSE_HEADING_YAW_PER_UNIT, -BEYOND_YAW, BEYOND_YAW),
        .position_std = disco_raw_u16(position_std, DISCO_POSE_HEADING_POSITION_STD_PER_UNIT),
        .yaw_std = disco_raw_u16(yaw_std, DISCO_POSE_HEADING_YAW_STD_PER_UNIT),
    };
}
