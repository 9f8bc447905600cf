//! What two pictures gave, as files: `twoview.json` and the points as PLY.
//!
//! Input: a [`TwoView`]. Output: a JSON document that an independent program can check (matrices row-major, `x_Bᵀ F x_A = 0`,
//! `[R | t]` = second_from_first, |t| = 1; every match with both places, residual and inlier flag; numbers that do not
//! exist are null, never NaN), and an ASCII PLY: points blue, the two cameras' centres red, axes of the first camera
//! (x right, y down, z forward), unit: the baseline.
//!
//! Deliberately not here: reading either back.

use std::io::{self, Write};
use std::path::Path;

use nalgebra::{Matrix3, Vector2, Vector3};
use serde::Serialize;
use serde_json::{Value, json};

use super::pose::{CANDIDATES, FourMotions, PoseSteps};
use super::two_view::{Options, TwoView};
use crate::atomic_file::{WriteError, write_atomically};
use crate::geometry::Se3;
use crate::geometry::fundamental::Degeneracy;

/// Colours of the PLY.
const POINT: [u8; 3] = [40, 90, 220];
const CAMERA: [u8; 3] = [220, 30, 30];

/// A matrix as rows.
pub fn rows(m: &Matrix3<f64>) -> [[f64; 3]; 3] {
    std::array::from_fn(|r| std::array::from_fn(|c| m[(r, c)]))
}

fn list(v: &Vector3<f64>) -> [f64; 3] {
    [v.x, v.y, v.z]
}

fn place(v: &Vector2<f64>) -> [f64; 2] {
    [v.x, v.y]
}

fn motion<A, B>(m: &Se3<A, B>) -> Value {
    json!({ "R": rows(m.rotation.to_rotation_matrix().matrix()), "t": list(&m.translation) })
}

/// One match in the document.
#[derive(Debug, Serialize)]
struct MatchRecord {
    /// Pixels of the pictures.
    a: [f64; 2],
    b: [f64; 2],
    /// Undistorted pixels: what F is for. Left out where the pictures' own pixels are.
    #[serde(skip_serializing_if = "Option::is_none")]
    a_undistorted: Option<[f64; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    b_undistorted: Option<[f64; 2]>,
    /// What the places are uncertain by: pixels of each picture a pixel of the scale that the patches were laid onto each other at, or the
    /// corner was found at.
    size_px: [f64; 2],
    /// Whether they could be laid onto each other.
    polished: bool,
    /// The matcher's measure.
    distance: f64,
    /// Found along an epipolar line in the guided round.
    guided: bool,
    /// Inlier of the F of the matches alone, and of the result.
    inlier_fundamental: Option<bool>,
    inlier: bool,
    /// Sampson distance from F, pixels.
    residual_px: Option<f64>,
    /// In the first camera's axes; null for outliers and points too far.
    point: Option<[f64; 3]>,
}

fn degeneracy(d: &Degeneracy) -> Value {
    match d {
        Degeneracy::None => json!({ "name": "none" }),
        Degeneracy::DominantPlane { homography, on_plane } => {
            json!({ "name": "dominant_plane", "homography": rows(homography), "on_plane": on_plane })
        }
        Degeneracy::Plane { homography, on_plane } => {
            json!({ "name": "plane", "homography": rows(homography), "on_plane": on_plane })
        }
        Degeneracy::PureRotation { homography, on_plane } => {
            json!({ "name": "pure_rotation", "homography": rows(homography), "on_plane": on_plane })
        }
    }
}

fn four(f: &FourMotions) -> Value {
    let candidates: Vec<Value> = (0..4)
        .map(|k| {
            let mut value = motion(&f.candidates[k]);
            value["name"] = json!(CANDIDATES[k]);
            value["votes"] = json!(f.votes[k]);
            value["one_point_count"] = json!(f.one_point_counts[k]);
            value
        })
        .collect();
    json!({
        "E": rows(&f.essential),
        "inliers": f.inliers,
        "candidates": candidates,
        "chosen_by_one_point": f.by_one_point.map(|k| CANDIDATES[k]),
        "chosen_by_votes": CANDIDATES[f.winner()],
    })
}

fn pose(steps: &PoseSteps) -> Value {
    json!({
        "singular_values_of_KbT_F_Ka": steps.singular_values,
        "from_fundamental": steps.from_fundamental.as_ref().map(four),
        "five_point": steps.five_point.as_ref().map(four),
        "five_point_samples": steps.five_point_iterations,
        "judge": match &steps.judged {
            Ok(found) => json!({
                "accepted": true,
                "model": format!("{:?}", found.model).to_lowercase(),
                "homography_ratio": found.homography_ratio,
                "votes": found.votes,
                "votes_runner_up": found.votes_runner_up,
                "points_with_parallax": found.wide_points,
            }),
            Err(reason) => json!({ "accepted": false, "reason": reason.to_string() }),
        },
        "other_motion": steps.other.as_ref().map(motion),
        "solution": steps.solution.as_ref().map(|s| json!({
            "started_from": s.origin,
            "inliers": s.inliers.iter().filter(|i| **i).count(),
            "points": s.points.iter().flatten().count(),
            "median_parallax_deg": s.median_parallax_rad.to_degrees(),
            "linear_triangulation_median_relative_difference": s.linear_difference,
            "adjustment": {
                "iterations": s.adjusted.iterations,
                "rms_before_px": s.adjusted.rms_before_px,
                "rms_after_px": s.adjusted.rms_after_px,
                "sigma_rotation_deg": s.adjusted.sigma_rotation_rad.to_degrees(),
                "sigma_translation_direction_deg": s.adjusted.sigma_direction_rad.to_degrees(),
            },
        })),
    })
}

/// The document. `pictures`: the names of both files.
pub fn document(result: &TwoView, pictures: [&str; 2], sizes: [(usize, usize); 2], options: &Options) -> Value {
    let solution = result.pose.as_ref().and_then(|p| p.solution.as_ref());
    let inliers = result.inliers();
    let residuals = result.residuals_px();
    let finite = |v: f64| v.is_finite().then_some(v);
    let matches: Vec<MatchRecord> = result
        .pairs
        .iter()
        .enumerate()
        .map(|(i, p)| MatchRecord {
            a: place(&p.a),
            b: place(&p.b),
            a_undistorted: result.undistorted.then(|| place(&result.ideal[i][0])),
            b_undistorted: result.undistorted.then(|| place(&result.ideal[i][1])),
            size_px: p.size_px,
            polished: p.polished,
            distance: p.distance,
            guided: i >= result.unguided,
            inlier_fundamental: result.epipolar.as_ref().map(|e| e.estimate.inliers[i]),
            inlier: inliers[i],
            residual_px: residuals.get(i).copied().and_then(finite),
            point: solution.and_then(|s| s.points[i].as_ref()).map(list),
        })
        .collect();
    let picture = |k: usize| {
        json!({
            "file": pictures[k],
            "width": sizes[k].0,
            "height": sizes[k].1,
            "corners_found": result.corners[k].found,
            "corners": result.corners[k].plain_count(),
            "corners_of_tilted_views": result.corners[k].keypoints.len() - result.corners[k].plain_count(),
            "scales": result.corners[k].scales.iter().filter(|s| s.is_plain()).count(),
        })
    };
    let mut outcome = json!(result.outcome);
    outcome["sentence"] = json!(result.outcome.sentence());
    json!({
        "program": concat!("cairn ", env!("CARGO_PKG_VERSION")),
        "outcome": outcome,
        "convention": "x_B^T F x_A = 0 with x = (column, row, 1), pixel (0, 0) the centre of the first pixel; [R | t] = second_from_first: X_B = R X_A + t, |t| = 1; matrices are lists of rows",
        "F_is": if solution.is_some_and(|s| s.fundamental.is_some()) { "of the motion: inverse(K_B)^T E inverse(K_A)" } else { "of the matches alone" },
        "pixels_of_F": if result.undistorted { "undistorted: K times the undistorted normalised point (a_undistorted, b_undistorted)" } else { "the pictures' own (a, b)" },
        "pictures": [picture(0), picture(1)],
        "options": {
            "detector": options.detection.detector.name(),
            "scales": options.detection.scales,
            "max_corners": options.detection.max_corners,
            "matcher": options.matching.matcher.name(),
            "sigma_px": options.sigma_px,
            "guided": options.guided,
            "views": options.views.name(),
            "seed": options.seed,
        },
        "first_try_without_tilted_views": result.first_try.as_ref().map(|t| json!({
            "outcome": t.outcome,
            "matches": t.matches,
            "inliers": t.inliers,
            "kept": t.kept,
        })),
        "F": result.fundamental().map(|f| rows(&f)),
        "E": solution.map(|s| rows(&s.essential)),
        "R": solution.map(|s| rows(s.second_from_first.rotation.to_rotation_matrix().matrix())),
        "t": solution.map(|s| list(&s.second_from_first.translation)),
        "counts": {
            "matches": result.pairs.len(),
            "matches_guided": result.pairs.len().saturating_sub(result.unguided),
            "outside_the_lens_model": result.outside_lens,
            "inliers": inliers.iter().filter(|i| **i).count(),
            "points": solution.map_or(0, |s| s.points.iter().flatten().count()),
        },
        "fundamental": result.epipolar.as_ref().map(|e| json!({
            "F_of_matches": rows(&e.estimate.fundamental),
            "inliers": e.estimate.inlier_count,
            "samples": e.estimate.iterations,
            "msac_score": e.estimate.score,
            "log10_false_alarms": finite(e.estimate.log10_false_alarms),
            "median_residual_px": finite(e.median_px),
            "noise_sigma_px": finite(e.noise_px),
            "one_camera": e.one_camera,
            "degeneracy": degeneracy(&e.estimate.degeneracy),
        })),
        "pose": result.pose.as_ref().map(pose),
        "times_ms": result.times.iter().map(|(k, v)| ((*k).to_string(), json!(v))).collect::<serde_json::Map<_, _>>(),
        "matches": matches,
    })
}

/// Writes a document, whole or not at all.
pub fn write_json(path: &Path, document: &Value) -> Result<(), WriteError> {
    write_atomically(path, |out| {
        serde_json::to_writer_pretty(&mut *out, document).map_err(io::Error::from)?;
        out.write_all(b"\n")
    })
}

/// Writes the points and both cameras' centres.
pub fn write_ply(
    path: &Path,
    points: &[Vector3<f64>],
    second_from_first: &Se3<impl Sized, impl Sized>,
) -> Result<(), WriteError> {
    let finite = |p: &&Vector3<f64>| p.iter().all(|v| (*v as f32).is_finite());
    let count = points.iter().filter(finite).count() + 2;
    write_atomically(path, |out| {
        write!(
            out,
            "ply\nformat ascii 1.0\n\
             comment cairn twoview: points (blue) and the two cameras' centres (red)\n\
             comment axes of the first camera: x right, y down, z forward; unit: the baseline\n\
             element vertex {count}\n\
             property float x\nproperty float y\nproperty float z\n\
             property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
        )?;
        let mut vertex = |p: &Vector3<f64>, [r, g, b]: [u8; 3]| writeln!(out, "{} {} {} {r} {g} {b}", p.x, p.y, p.z);
        for p in points.iter().filter(finite) {
            vertex(p, POINT)?;
        }
        vertex(&Vector3::zeros(), CAMERA)?;
        vertex(&second_from_first.inverse().translation, CAMERA)
    })
}
