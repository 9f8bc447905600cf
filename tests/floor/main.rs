//! The camera's height above the floor, and what stands on it, on the simulator without threads: the map becomes metric, of the right scale and never by
//! something that is no floor; and what is said of obstacles and free floor is so.

mod drive;
mod obstacles;
mod scale;
