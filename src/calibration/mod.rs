//! Cameras' calibrations: how they come in from files and go out to them.

pub mod chessboard;
pub mod file;
pub mod foreign;
mod yaml;

pub use file::{CalibrationError, CalibrationFile, load_camera, save_camera};
