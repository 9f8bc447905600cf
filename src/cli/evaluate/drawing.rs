//! What an evaluation found, as a picture.

use std::path::Path;

use crate::evaluation::association::CoverageBasis;
use crate::evaluation::metrics::Statistics;
use crate::evaluation::{Evaluation, Outcome};
use crate::plot::{self, ComparedFrame, ComparedPose, Comparison, ErrorRange, PlotError};

/// Draws `outcome` to `path`.
pub fn write_comparison(path: &Path, outcome: &Outcome, title: &str) -> Result<(), PlotError> {
    plot::write_comparison(path, &comparison(outcome), title)
}

fn comparison(outcome: &Outcome) -> Comparison {
    let figures = &outcome.figures;
    let range = |s: Statistics| ErrorRange { rmse: s.rmse, max: s.max };
    let frames = outcome.expected.iter().map(|e| ComparedFrame {
        timestamp_ns: e.timestamp_ns,
        truth: e.truth_position,
        covered: e.covered,
    });
    let poses = outcome.samples.iter().map(|s| ComparedPose {
        timestamp_ns: s.timestamp_ns,
        position: s.estimate.translation,
        position_error_m: s.position_error_m,
        rotation_error_deg: s.rotation_error_deg,
    });
    Comparison {
        facts: facts(figures),
        frames: frames.collect(),
        poses: poses.collect(),
        position_m: figures.ate_m.map(range),
        rotation_deg: figures.rotation_deg.map(range),
        without_errors: figures.notes.iter().find(|n| n.starts_with("no errors")).cloned().unwrap_or_default(),
    }
}

/// The figures that stand under the title.
fn facts(figures: &Evaluation) -> Vec<(&'static str, String)> {
    let of = match figures.coverage_basis {
        CoverageBasis::Frames => "frames",
        CoverageBasis::GroundTruthSamples => "ground-truth samples",
    };
    let mut facts = vec![("coverage", format!("{:.1} % of {} {of}", figures.coverage_percent, figures.expected))];
    if let Some(ate) = &figures.ate_m {
        facts.insert(0, ("ATE RMSE", length(ate.rmse)));
    }
    if let Some(rotation) = &figures.rotation_deg {
        facts.push(("rotation RMSE", format!("{:.2}°", rotation.rmse)));
    }
    if let Some(relative) = &figures.relative {
        let (t, r) = (relative.translation_percent.rmse, relative.rotation_deg_per_m.rmse);
        facts.push(("relative", format!("{t:.2} %, {r:.2}°/m")));
    }
    if figures.path_m > 0.0 {
        facts.push(("path", format!("{:.2} m", figures.path_m)));
    }
    facts
}

/// A length with a readable unit.
fn length(metres: f64) -> String {
    if metres < 0.1 { format!("{:.2} mm", 1e3 * metres) } else { format!("{metres:.3} m") }
}
