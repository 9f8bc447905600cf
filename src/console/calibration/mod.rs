//! A calibration in a page: somebody holds a chessboard before the robot's camera, and the page says what is still missing.
//!
//! ```text
//! feed of pictures ──► tray (a copy when one is asked for) ──► worker: session ──► hub ──► pages that show it
//!                                                                ▲
//!                                        start, finish, save, cancel: orders of any page
//! ```
//!
//! Input: the pictures that pages see, orders of pages. Output: a message after each picture that was looked at: the board in it, what to do next,
//! what is known so far, and the outcome. How a board is found and a camera calibrated this room does not know: `cli` hands in a
//! [`Calibrator`], which is the code of `cairn calibrate`.
//!
//! One calibration at a time, whichever page began it, in one thread that takes at most half of a core. The daemon gives no more than its
//! pictures, as to any page; nothing is kept of a picture but the corners in it.

mod guided;
mod session;
mod tray;
mod worker;

pub use guided::{
    Board, Calibrator, Camera, Gauge, Glance, Guidance, Guided, Lens, Look, Need, Outcome, Picture, Value,
};
pub use session::{Action, Session, Told};
pub use tray::Tray;
pub use worker::{Desk, run};
