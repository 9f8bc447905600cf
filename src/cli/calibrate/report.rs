//! The report's pictures: every view with corners and residual arrows, and the coverage map.

use std::path::Path;

use crate::calibration::boards::{BoardView, Calibrated};
use crate::calibration::verdict::COVERAGE;
use crate::cli::{CliError, exit_code};
use crate::image::GreyImage;
use crate::plot::{BoardCorner, write_coverage, write_view};

/// Views that are drawn; more would fill a disk for nothing.
const MAX_PICTURES: usize = 100;

/// Writes into `folder`; `picture_of` decodes the picture of a view. Returns the number of files.
pub fn write(
    folder: &Path,
    views: &[BoardView],
    calibrated: &Calibrated,
    size: (u32, u32),
    mut picture_of: impl FnMut(usize, &mut GreyImage) -> bool,
) -> Result<usize, CliError> {
    let failed = |e: String| CliError::new(exit_code::CANNOT_CREATE, e);
    std::fs::create_dir_all(folder).map_err(|e| failed(format!("{}: {e}", folder.display())))?;
    let mut all = Vec::new();
    let mut files = 0;
    let mut picture = GreyImage::default();
    for (n, (view, solved)) in views.iter().zip(&calibrated.solved.views).enumerate() {
        let marks: Vec<BoardCorner> = view
            .board
            .corners
            .iter()
            .zip(solved.residuals.iter().zip(&solved.used_points))
            .map(|(c, (residual, used))| BoardCorner {
                pixel: c.pixel,
                residual: *residual,
                used: *used && solved.used,
            })
            .collect();
        if n < MAX_PICTURES && picture_of(n, &mut picture) {
            let name =
                Path::new(&view.name).file_name().map_or(view.name.clone(), |f| f.to_string_lossy().into_owned());
            let title = format!("{name}: {}", calibrated.view_words(solved));
            let path = folder.join(format!("view-{:03}.png", n + 1));
            write_view(&path, &picture, &marks, &title).map_err(|e| failed(e.to_string()))?;
            files += 1;
        }
        all.extend(marks);
    }
    let verdict = &calibrated.verdict;
    let sigmas = calibrated.solved.sigmas();
    let mut lines = vec![format!(
        "fx {:.2} +- {:.2}, fy {:.2} +- {:.2} px, residual {:.3} px, {:.0} % covered, red: no corner",
        calibrated.camera.fx,
        sigmas[0],
        calibrated.camera.fy,
        sigmas[1],
        calibrated.solved.rms_px,
        verdict.covered_percent
    )];
    lines.extend(verdict.needs.iter().map(|need| format!("missing: {need}")));
    write_coverage(&folder.join("coverage.png"), size, COVERAGE, &verdict.cells, &all, &lines)
        .map_err(|e| failed(e.to_string()))?;
    Ok(files + 1)
}
