//! What the console asks of whoever knows how to calibrate, and what it is told.

use std::fmt::Debug;

use serde::{Deserialize, Serialize};

/// Model of the lens, as `cairn calibrate --distortion` names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Lens {
    #[default]
    Full,
    Fisheye,
}

/// The board that a page says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Board {
    /// Inner corners a row.
    pub columns: u32,
    /// Inner corners a column.
    pub rows: u32,
    /// Side of a square, m. A camera comes out the same without; only distances need it.
    pub square_m: Option<f64>,
    #[serde(default)]
    pub lens: Lens,
}

impl Board {
    /// The same on a terminal; `device`: the camera's.
    pub fn terminal(&self, device: Option<&str>) -> String {
        let mut line =
            format!("cairn calibrate --camera {} --pattern {}x{}", device.unwrap_or("auto"), self.columns, self.rows);
        if let Some(square_m) = self.square_m {
            line += &format!(" --square {square_m}");
        }
        if self.lens == Lens::Fisheye {
            line += " --distortion fisheye";
        }
        line
    }
}

/// A grey picture in rows without gaps.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Picture {
    /// Which start of the daemon it is from.
    pub run_id: u64,
    pub sequence: u64,
    /// When it was taken, ns of the camera's clock.
    pub time_ns: i64,
    pub width: usize,
    pub height: usize,
    pub pixels: Vec<u8>,
}

/// What a picture came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Look {
    NoBoard,
    OtherBoard,
    /// Moving, blurred or partly hidden.
    Unfit,
    /// Like a view that was taken.
    Known,
    Taken,
}

/// A picture that was looked at.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Glance {
    pub sequence: u64,
    /// Of the picture, px.
    pub size: [usize; 2],
    pub look: Look,
    /// What to do now.
    pub advice: String,
    /// The board's corners, a row of the board after the other: x, y, x, y, ..., px.
    pub corners: Vec<Vec<f32>>,
}

/// Something that is still missing.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Need {
    /// One word for it: `left`, `sideways`, `precision`, ...
    pub name: &'static str,
    pub missing: String,
    pub advice: String,
}

/// How far something has come.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Gauge {
    /// Name of the [`Need`] that it measures.
    pub name: &'static str,
    pub label: &'static str,
    /// What it is, and what is wanted.
    pub text: String,
    /// 0 to 1; `None` where nothing is asked for.
    pub share: Option<f64>,
}

/// What the views that were taken show, and what is missing.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Guidance {
    pub views: usize,
    /// So many end it, once nothing is missing; and so many whatever is missing.
    pub enough: usize,
    pub most: usize,
    /// Columns and rows of the coverage map.
    pub grid: [usize; 2],
    /// Corners in each cell, row by row.
    pub cells: Vec<u32>,
    /// The outer corners of each view's board: x, y of four, as shares of the picture's width and height.
    pub outlines: Vec<[f32; 8]>,
    pub gauges: Vec<Gauge>,
    /// Empty before anything can be said.
    pub needs: Vec<Need>,
    /// There is a camera already, such as it is.
    pub solved: bool,
}

/// A parameter of the camera.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Value {
    pub name: &'static str,
    pub value: f64,
    /// One standard deviation; `None` for one that was not estimated.
    pub sigma: Option<f64>,
    pub unit: &'static str,
}

/// A calibrated camera.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Outcome {
    pub values: Vec<Value>,
    /// The views constrain the camera well.
    pub good: bool,
    /// What is to be said of it, a statement each.
    pub words: Vec<String>,
    /// The calibration file, and a name for it.
    pub file: String,
    pub file_name: String,
}

/// The camera that a daemon has open.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Camera {
    /// As its calibrations are found by.
    pub identity: String,
    /// Such as `/dev/video0`.
    pub device: String,
}

/// Begins calibrations.
pub trait Calibrator: Debug + Send + Sync {
    /// The error says what is wrong with the board.
    fn begin(&self, board: &Board) -> Result<Box<dyn Guided>, String>;
}

/// A calibration under way.
pub trait Guided: Debug + Send {
    /// Looks at a picture, and takes it for a view if it is a good one.
    fn look(&mut self, picture: Picture) -> Glance;

    fn guidance(&self) -> Guidance;

    /// Nothing is missing any more, or nothing more is taken.
    fn is_done(&self) -> bool;

    /// The camera as far as it is known; `None` if the views are too few.
    fn outcome(&self) -> Option<Outcome>;
}
