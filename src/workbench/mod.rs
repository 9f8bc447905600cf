//! The method as a workbench: two pictures to corners, matches, epipolar geometry, pose and points, each step in the open,
//! and its alternatives compared on many pairs.
//!
//! Input: picture files, calibrations, pairs with known truth. Output: what each step gave ([`two_view::TwoView`]), as a
//! JSON document and a PLY ([`report`]), and tables of comparisons ([`compare`]). Plain steps without threads; what they
//! do the daemon does too, with the same `features` and `geometry`, but for a stream and under a time limit.
//!
//! Deliberately not here: drawing (`plot`), printing and exit codes (`cli`), the map.

pub mod adjustment;
pub mod compare;
pub mod detect;
pub mod guided;
pub mod pairing;
pub mod picture;
pub mod polish;
pub mod pose;
pub mod report;
pub mod scales;
pub mod two_view;

pub use detect::{Detection, Detector};
pub use pairing::{Matcher, Matching};
pub use picture::{Picture, PictureError};
pub use two_view::{Cameras, Options, Outcome, TwoView, Views, reconstruct};
