//! What the robot knows besides the picture: wheel odometry, tags of known size, the height above the floor; and from these the
//! scale of the map in metres.

pub mod floor;
pub mod hand_eye;
pub mod obstacles;
pub mod planar;
pub mod scale;
#[cfg(test)]
mod synthetic;
pub mod tag;
pub mod wheel;
pub mod wheel_scale;
