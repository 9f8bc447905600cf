//! What can be asked of two pictures, and everything that comes out.

use nalgebra::{Matrix3, Vector2};

use crate::geometry::camera_model::CameraModel;
use crate::geometry::epipolar::sampson_squared;
use crate::geometry::fundamental::FundamentalEstimate;
use crate::workbench::detect::{Corners, Detection};
use crate::workbench::pairing::{Matching, Pair};
use crate::workbench::pose::{PoseSteps, median};

/// When tilted views are simulated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Views {
    /// Where the pictures as they are give no model, or one of few matches
    Auto,
    /// Always
    Affine,
    /// Never
    None,
}

impl Views {
    /// As on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Affine => "affine",
            Self::None => "none",
        }
    }
}

/// What the pictures gave without tilted views, where it was tried again with them.
#[derive(Debug, Clone, PartialEq)]
pub struct FirstTry {
    pub outcome: Outcome,
    pub matches: usize,
    pub inliers: usize,
    /// Whether this try is the one that counts, the views having shown no more.
    pub kept: bool,
}

/// Epipolar geometry of the matches.
#[derive(Debug, Clone, PartialEq)]
pub struct Epipolar {
    pub estimate: FundamentalEstimate,
    /// Sampson distance of each match, pixels; NaN for a pair of epipoles.
    pub residuals_px: Vec<f64>,
    /// Median over the inliers, pixels.
    pub median_px: f64,
    /// One sigma of the noise that the inliers show of this F, pixels.
    pub noise_px: f64,
    /// F is that of one camera with its principal point in the middle of both pictures, which explains the matches about as well as any F
    /// (beyond chance, worse by at most a few hundredths of a pixel a match).
    pub one_camera: bool,
}

/// Fewer matches are not tried: seven make an F, and one that nothing confirms.
pub const MIN_MATCHES: usize = 8;

/// What can be chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    pub detection: Detection,
    pub matching: Matching,
    /// Of matchers that know no tilt (attributes, correlation, flow): never.
    pub views: Views,
    /// One sigma of a corner's place, pixels; an inlier lies within 1.96 of it.
    pub sigma_px: f64,
    /// Match again along the epipolar lines.
    pub guided: bool,
    pub seed: u64,
    /// Give the best motion found even where nothing makes it stand out from chance; the outcome stays what it is.
    pub always_answer: bool,
}

/// The cameras of both pictures.
#[derive(Debug, Clone, PartialEq)]
pub struct Cameras {
    pub a: CameraModel,
    pub b: CameraModel,
}

/// How far the chain came.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
#[serde(rename_all = "snake_case", tag = "name")]
pub enum Outcome {
    /// Pose and points.
    Reconstructed,
    /// Epipolar geometry; no camera was given, so no more can be had.
    FundamentalOnly,
    /// Both files show the very same pixels.
    IdenticalPictures,
    /// Hardly anything to see in one of the pictures.
    TooFewCorners { first: usize, second: usize },
    /// Hardly anything of one picture found in the other.
    TooFewMatches { matches: usize, needed: usize },
    /// No epipolar geometry stands out from chance.
    NoModel { matches: usize },
    /// A homography explains the matches and no camera says more: F is one of many.
    Plane { on_plane: usize },
    /// A rotation explains the matches: the camera turned and did not move. Without a camera: or it saw a plane, moving just so.
    PureRotation { angle_deg: Option<f64> },
    /// The camera moved too little for how far away things are.
    LowParallax { median_deg: f64 },
    /// Two motions explain the matches equally well, as a plane allows.
    Ambiguous,
    /// Epipolar geometry, but no motion puts enough points in front of both cameras.
    NoPose { reason: String },
}

impl Outcome {
    /// Is there what was asked for?
    pub fn is_success(&self) -> bool {
        matches!(self, Self::Reconstructed | Self::FundamentalOnly)
    }

    /// One sentence.
    pub fn sentence(&self) -> String {
        match self {
            Self::Reconstructed => "relative pose and points reconstructed".into(),
            Self::FundamentalOnly => {
                "stopped after F: without --camera the focal lengths are unknown, and with them angles and depths"
                    .into()
            }
            Self::IdenticalPictures => "the two pictures are identical: nothing moved, so nothing can be said".into(),
            Self::TooFewCorners { first, second } => {
                format!("too few corners: {first} in the first picture, {second} in the second")
            }
            Self::TooFewMatches { matches, needed } => {
                format!("too few matches: {matches}, at least {needed} are needed")
            }
            Self::NoModel { matches } => {
                format!("no model: no epipolar geometry of {matches} matches stands out from chance")
            }
            Self::Plane { on_plane } => {
                format!(
                    "a plane: one homography explains {on_plane} matches, so F is one of many; a camera would tell more"
                )
            }
            Self::PureRotation { angle_deg: Some(angle) } => {
                format!("pure rotation: a turn of {angle:.2} degrees explains the matches, so there is no translation")
            }
            Self::PureRotation { angle_deg: None } => {
                "pure rotation, or a plane that looks like one: a turn of a usual camera explains the matches, so F is one of many; \
                 without --camera the two cannot be told apart"
                    .into()
            }
            Self::LowParallax { median_deg } => {
                format!("low parallax: {median_deg:.3} degrees in the median, the camera moved too little")
            }
            Self::Ambiguous => {
                "ambiguous: two motions explain the matches, as a plane allows; a third view would tell".into()
            }
            Self::NoPose { reason } => format!("no pose: {reason}"),
        }
    }
}

/// Everything that came out.
#[derive(Debug, Clone)]
pub struct TwoView {
    pub corners: [Corners; 2],
    /// Matches, with a guided round those of both.
    pub pairs: Vec<Pair>,
    /// How many of them the first matching gave.
    pub unguided: usize,
    /// Matches left out because their pixel has no undistorted place under the camera's model, or lies more than 50 degrees off the axis
    /// of a wide-angle lens.
    pub outside_lens: usize,
    /// Each match's places in undistorted pixels; the pictures' own pixels without cameras.
    pub ideal: Vec<[Vector2<f64>; 2]>,
    /// Whether `ideal` and F are in undistorted pixels.
    pub undistorted: bool,
    pub epipolar: Option<Epipolar>,
    pub pose: Option<PoseSteps>,
    pub outcome: Outcome,
    /// What came without tilted views, where it was tried again with them.
    pub first_try: Option<FirstTry>,
    /// Each step's name and milliseconds.
    pub times: Vec<(&'static str, f64)>,
}

impl TwoView {
    /// One a match: inlier of the pose if there is one, otherwise of F.
    pub fn inliers(&self) -> Vec<bool> {
        let pose = self.pose.as_ref().and_then(|p| p.solution.as_ref()).map(|s| s.inliers.clone());
        pose.or_else(|| self.epipolar.as_ref().map(|e| e.estimate.inliers.clone()))
            .unwrap_or_else(|| vec![false; self.pairs.len()])
    }

    /// The epipolar geometry at the chain's end, in the pixels of [`TwoView::ideal`]: that of the motion where there is one, otherwise
    /// that of the matches alone. Cameras leave five numbers open and not seven, so a hundredth of a pixel that the matches are
    /// wrong by, all in one part of a picture, bends it less.
    pub fn fundamental(&self) -> Option<Matrix3<f64>> {
        let solution = self.pose.as_ref().and_then(|p| p.solution.as_ref());
        solution.and_then(|s| s.fundamental).or_else(|| self.epipolar.as_ref().map(|e| e.estimate.fundamental))
    }

    /// Sampson distance of each match from [`Self::fundamental`], pixels; NaN for a pair of epipoles. Nothing without it.
    pub fn residuals_px(&self) -> Vec<f64> {
        let Some(f) = self.fundamental() else { return Vec::new() };
        self.ideal.iter().map(|[a, b]| sampson_squared(&f, a, b).sqrt()).collect()
    }

    /// Median of [`Self::residuals_px`] over the inliers, pixels; NaN without any.
    pub fn median_px(&self) -> f64 {
        let all = self.residuals_px();
        let mut of_inliers: Vec<f64> = all.iter().zip(&self.inliers()).filter(|(_, i)| **i).map(|(r, _)| *r).collect();
        median(&mut of_inliers)
    }

    /// Milliseconds of all steps.
    pub fn total_ms(&self) -> f64 {
        self.times.iter().map(|(_, ms)| ms).sum()
    }
}
