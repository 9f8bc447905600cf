//! Cameras' calibrations: made from views of a chessboard, read and written, found again.
//!
//! `chessboard` finds the board in a picture; `boards` makes a camera of many of them, with `verdict` on what is missing; `guide`
//! does both live. `file`, `yaml` and `foreign` read the formats and `export` writes them, `store` is where calibrations lie, `pattern_sheet` prints the board.

pub mod boards;
pub mod chessboard;
mod error;
pub mod export;
mod field;
pub mod file;
mod foreign;
pub mod guide;
pub mod pattern_sheet;
pub mod store;
pub mod verdict;
mod yaml;

pub use file::{CalibrationError, CalibrationFile, Unsaid, load_camera, load_camera_with, save_camera};
