//! A comparison as Markdown.

use super::{Comparison, RIGHT_DEG, Score, Summary};

fn figure(value: Option<f64>, decimals: usize) -> String {
    value.map_or("–".into(), |v| format!("{v:.decimals$}"))
}

fn percent(value: Option<f64>) -> String {
    figure(value.map(|v| 100.0 * v), 0)
}

/// One row a way.
pub fn summary(comparison: &Comparison) -> String {
    let mut out = String::from(
        "| detector | matcher | corners | repeatability % | matches | correct | correct % | inliers % | models | poses right | rotation ° | direction ° | annotated px | corners ms | all ms |\n\
         |---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|\n",
    );
    for s in &comparison.summaries {
        let Summary { detector, matcher, .. } = s;
        out += &format!(
            "| {} | {} | {:.0} | {} | {:.0} | {} | {} | {} | {} of {} | {} | {} | {} | {} | {:.0} | {:.0} |\n",
            detector.name(),
            matcher.name(),
            s.corners,
            percent(s.repeatability),
            s.matches,
            figure(s.correct, 0),
            percent(s.precision),
            percent(s.inlier_share),
            s.with_model,
            s.pairs,
            s.right.map_or("–".into(), |(right, of)| format!("{right} of {of}")),
            figure(s.rotation_error_deg, 2),
            figure(s.direction_error_deg, 2),
            figure(s.annotated_px, 2),
            s.corners_ms,
            s.total_ms,
        );
    }
    let (rotation, direction) = RIGHT_DEG;
    out += &format!(
        "\nMedians over the pairs that a figure exists for. A pose is right within {rotation:.0}° of rotation and {direction:.0}° of \
         direction; a pair without a pose counts as 180° in the medians. Without depth a match is correct within 3 px of \
         its true epipolar line.\n"
    );
    out
}

/// One row a pair and way.
pub fn details(comparison: &Comparison) -> String {
    let mut out = String::from(
        "| pair | detector | matcher | corners | repeatability % | matches | correct | inliers | outcome | rotation ° | direction ° | annotated px | tilt, row angle ° | ms |\n\
         |---|---|---|---:|---:|---:|---:|---:|---|---:|---:|---:|---:|---:|\n",
    );
    for s in &comparison.scores {
        let Score { corners: [a, b], .. } = s;
        out += &format!(
            "| {} | {} | {} | {a}, {b} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {:.0} |\n",
            s.pair,
            s.detector.map_or("(listed)", |d| d.name()),
            s.matcher.map_or("(listed)", |m| m.name()),
            percent(s.repeatability),
            s.matches,
            s.correct.map_or("–".into(), |c| c.to_string()),
            s.inliers,
            s.outcome,
            figure(s.rotation_error_deg, 2),
            figure(s.direction_error_deg, 2),
            figure(s.annotated_px, 2),
            s.row_tilt_deg.zip(s.row_angle_deg).map_or("–".into(), |(t, a)| format!("{t:.3}, {a:.3}")),
            s.total_ms,
        );
    }
    out
}
