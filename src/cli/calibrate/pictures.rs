//! Calibration from picture files.

use std::path::Path;
use std::process::ExitCode;

use super::args::CalibrateArgs;
#[cfg(feature = "tools")]
use super::output::report_folder;
use super::output::save;
#[cfg(feature = "tools")]
use super::report;
use crate::calibration::boards::{BoardView, solve};
use crate::calibration::chessboard::{Detector, Pattern, Sighting};
use crate::cli::session::{self, StatusLine};
use crate::cli::{CliError, exit_code};
use crate::frame::{PixelFormat, RawFrame};
use crate::image::GreyImage;
use crate::image::decode::Decoder;

/// A picture is at most so long, bytes.
const MAX_BYTES: u64 = 64 << 20;

/// Reads and decodes one picture.
pub fn read(path: &Path, decoder: &mut Decoder, picture: &mut GreyImage) -> Result<(), String> {
    let length = std::fs::metadata(path).map_err(|e| e.to_string())?.len();
    if length > MAX_BYTES {
        return Err(format!("is longer than {MAX_BYTES} bytes"));
    }
    let data = std::fs::read(path).map_err(|e| e.to_string())?;
    // Which of the two it is the bytes say.
    let raw = RawFrame { format: PixelFormat::Jpeg, data, ..RawFrame::default() };
    decoder.decode(&raw, picture).map_err(|e| e.to_string())
}

pub fn run(args: &CalibrateArgs, pattern: &Pattern) -> Result<ExitCode, CliError> {
    session::check_outputs([&args.output])?;
    let (mut detector, mut decoder, mut picture) = (Detector::default(), Decoder::default(), GreyImage::default());
    let mut views = Vec::new();
    let mut size = None;
    let mut other_sizes: Vec<(u32, u32)> = Vec::new();
    let mut line = StatusLine::new(args.quiet);
    for (n, path) in args.pictures.iter().enumerate() {
        line.show(&format!("{}/{} {}", n + 1, args.pictures.len(), path.display()));
        let name = path.display().to_string();
        let mut skip = |reason: &str| line.note(&format!("{name}: {reason}, skipped"));
        if let Err(reason) = read(path, &mut decoder, &mut picture) {
            if !path.exists() {
                return Err(CliError::new(exit_code::NO_INPUT, format!("{name}: {reason}")));
            }
            skip(&reason);
            continue;
        }
        let own = (picture.width as u32, picture.height as u32);
        if let Some((w, h)) = size.filter(|s| *s != own) {
            skip(&format!("{}x{} px, the first picture has {w}x{h} px", own.0, own.1));
            continue;
        }
        match detector.detect(&picture, pattern) {
            Sighting::Board(board) => {
                size = Some(own);
                if !board.complete {
                    line.note(&format!("{name}: {} of {} corners seen", board.corners.len(), pattern.count()));
                }
                views.push(BoardView::still(name, board));
            }
            Sighting::OtherSize(columns, rows) => {
                other_sizes.push((columns, rows));
                skip(&format!(
                    "a board of {columns}x{rows} inner corners was seen, {}x{} was asked for",
                    pattern.columns, pattern.rows
                ));
            }
            Sighting::Nothing => skip("no board seen"),
        }
    }
    // The size that most of them have.
    let count = |size: &(u32, u32)| other_sizes.iter().filter(|s| *s == size).count();
    let other_size = other_sizes.iter().max_by_key(|size| (count(size), **size)).copied();
    line.clear();
    let summary = format!("{} of {} pictures show the board\n", views.len(), args.pictures.len());
    let Some(size) = size else {
        let hint = match other_size {
            Some((c, r)) => format!(
                ": a board of {c}x{r} inner corners was seen, {}x{} was asked for (count the corners between the squares; or is a part of it hidden?)",
                pattern.columns, pattern.rows
            ),
            None => String::new(),
        };
        return Err(CliError::new(exit_code::DATA, format!("no picture shows the board{hint}")));
    };
    if let Some((c, r)) = other_size {
        let message = format!(
            "{} of {} pictures show a board of {c}x{r} inner corners, {}x{} was asked for: is `--pattern {c}x{r}` meant?",
            count(&(c, r)),
            args.pictures.len(),
            pattern.columns,
            pattern.rows
        );
        // Where most show a larger board, the others show a part of it.
        let fits = pattern.columns.max(pattern.rows) <= c && pattern.columns.min(pattern.rows) <= r;
        if fits && count(&(c, r)) > views.len() {
            return Err(CliError::new(exit_code::DATA, message));
        }
        line.note(&format!("cairn: {message}"));
    }
    let calibrated = solve(&views, pattern, size, args.distortion.into())
        .map_err(|e| CliError::new(exit_code::DATA, format!("{}{e}", summary)))?;
    let mut text = summary;
    for (view, solved) in views.iter().zip(&calibrated.solved.views) {
        text += &format!("  {}: {}\n", view.name, calibrated.view_words(solved));
    }
    text += &calibrated.table();
    text += &calibrated.words();
    session::print(&text)?;
    save(args, &calibrated, None)?;
    #[cfg(feature = "tools")]
    if let Some(folder) = report_folder(args) {
        let path = |n: usize| args.pictures.iter().find(|path| path.display().to_string() == views[n].name);
        let picture_of = |n: usize, out: &mut GreyImage| {
            path(n).is_some_and(|path| read(path, &mut Decoder::default(), out).is_ok())
        };
        let files = report::write(&folder, &views, &calibrated, size, picture_of)?;
        session::print(&format!("wrote {files} pictures in {}\n", folder.display()))?;
    }
    Ok(ExitCode::SUCCESS)
}
