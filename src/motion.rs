//! What the robot knows besides the picture: wheel odometry, tags of known size, the height above the floor; and from these the
//! scale of the map in metres.

pub mod scale;
pub mod tag;
pub mod wheel;
