//! The 41x41 mask in two passes against one pass over every pixel: time ratio on real pictures, in the same run.
//!
//! `cargo bench --bench susan`: recorded pictures (`CAIRN_DATA`), at the study's 280x200 and at 640x480, several brightness
//! thresholds. Two passes must find no corner that the single pass does not, or the program fails; what they miss is counted.
//! `cargo bench --bench susan -- once SCHEME WIDTH HEIGHT T REPEATS` runs one scheme only (`single`, `small`,
//! or `none` for decoding and resizing alone), for counting instructions:
//! `valgrind --tool=callgrind target/release/deps/susan-* once small 280 200 90 10`.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use cairn::features::Corner;
use cairn::features::susan_large::{LargeSusanConfig, LargeSusanDetector, LargeSusanScheme};
use cairn::frame::{PixelFormat, RawFrame};
use cairn::image::GreyImage;
use cairn::image::decode::Decoder;

/// Pictures of different places and cameras, below the folder of recordings: one of each sequence that is there.
const FOLDERS: [&str; 8] = [
    "tum_fr1_xyz/rgb",
    "7scenes_redkitchen/rgb",
    "visp_rbt/rgb",
    "new_tsukuba/rgb",
    "uzh_parking/rgb",
    "two_view/fundamental",
    "two_view/scannet_pairs",
    "calib_opencv_left",
];

const RUNS: usize = 15;

fn main() -> ExitCode {
    let data = std::env::var_os("CAIRN_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let pictures: Vec<(String, GreyImage)> = FOLDERS.iter().filter_map(|f| picture_of(&data.join(f), f)).collect();
    if pictures.is_empty() {
        println!("skipped: no pictures below {}; CAIRN_DATA names the folder of recordings", data.display());
        return ExitCode::SUCCESS;
    }
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| a != "--bench").collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["once", scheme, width, height, t, repeats] => once(&pictures, scheme, [width, height, t, repeats]),
        [] => compare(&pictures),
        _ => {
            eprintln!("arguments: none, or once SCHEME WIDTH HEIGHT T REPEATS");
            ExitCode::from(2)
        }
    }
}

fn compare(pictures: &[(String, GreyImage)]) -> ExitCode {
    let mut right = true;
    for (width, height) in [(280, 200), (640, 480)] {
        for t in [20u8, 40, 90] {
            println!("\n{width}x{height}, t = {t}, hard step, g = 0.4; best of {RUNS} runs");
            println!(
                "{:<24} {:>8} {:>7} {:>10} {:>10} {:>7} {:>10}",
                "picture", "corners", "missed", "single ms", "double ms", "ratio", "measured %"
            );
            let mut sums = [0.0; 2];
            for (name, picture) in pictures {
                let picture = resized(picture, width, height);
                let [(single_ms, single, _), (double_ms, double, share)] = best_ms(&picture, t);
                println!(
                    "{name:<24} {:>8} {:>7} {single_ms:>10.3} {double_ms:>10.3} {:>7.1} {:>10.1}",
                    single.len(),
                    single.iter().filter(|c| !double.contains(c)).count(),
                    single_ms / double_ms,
                    100.0 * share,
                );
                let added = double.iter().filter(|c| !single.contains(c)).count();
                if added > 0 {
                    println!("  WRONG: {added} corners that the single pass does not have");
                    right = false;
                }
                sums[0] += single_ms;
                sums[1] += double_ms;
            }
            println!(
                "{:<24} {:>8} {:>7} {:>10.3} {:>10.3} {:>7.1}",
                "all",
                "",
                "",
                sums[0],
                sums[1],
                sums[0] / sums[1]
            );
        }
    }
    if right { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Single pass and two passes: shortest time (the machine may have other work; the two take turns), corners, and the
/// share of pixels that the large mask was laid on.
fn best_ms(picture: &GreyImage, t: u8) -> [(f64, Vec<Corner>, f64); 2] {
    let mut detectors = [LargeSusanScheme::SinglePass, LargeSusanScheme::SmallMask].map(detector);
    let mut corners = [Vec::new(), Vec::new()];
    let mut best = [f64::INFINITY; 2];
    for _ in 0..RUNS {
        for k in 0..2 {
            let start = Instant::now();
            detectors[k].detect_all(picture, t, &mut corners[k]);
            best[k] = best[k].min(start.elapsed().as_secs_f64() * 1e3);
        }
    }
    let share = detectors.map(|d| d.counts().measured as f64 / (picture.width * picture.height) as f64);
    let [single, double] = corners;
    [(best[0], single, share[0]), (best[1], double, share[1])]
}

fn detector(scheme: LargeSusanScheme) -> LargeSusanDetector {
    LargeSusanDetector::new(LargeSusanConfig { scheme, ..LargeSusanConfig::default() }).expect("the default is valid")
}

fn once(pictures: &[(String, GreyImage)], scheme: &str, numbers: [&str; 4]) -> ExitCode {
    let Ok([width, height, t, repeats]) =
        numbers.map(str::parse::<usize>).into_iter().collect::<Result<Vec<_>, _>>().map(|v| [v[0], v[1], v[2], v[3]])
    else {
        eprintln!("WIDTH HEIGHT T REPEATS must be whole numbers");
        return ExitCode::from(2);
    };
    let mut detector = match scheme {
        "single" => Some(detector(LargeSusanScheme::SinglePass)),
        "small" => Some(detector(LargeSusanScheme::SmallMask)),
        _ => None,
    };
    let mut corners = Vec::new();
    for (name, picture) in pictures {
        let picture = resized(picture, width, height);
        let Some(detector) = &mut detector else { continue };
        for _ in 0..repeats {
            detector.detect_all(&picture, t.min(255) as u8, &mut corners);
        }
        println!("{name}: {} corners, {:?}", corners.len(), detector.counts());
    }
    ExitCode::SUCCESS
}

/// The picture in the middle of a folder's list.
fn picture_of(folder: &Path, name: &str) -> Option<(String, GreyImage)> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder).ok()?.flatten().map(|e| e.path()).collect();
    files.retain(|f| f.extension().is_some_and(|e| e == "png" || e == "jpg" || e == "jpeg"));
    files.sort();
    let data = std::fs::read(files.get(files.len() / 2)?).ok()?;
    let format = cairn::image::decode::sniff(&data).unwrap_or(PixelFormat::Jpeg);
    let mut grey = GreyImage::default();
    Decoder::default().decode(&RawFrame { format, data, ..RawFrame::default() }, &mut grey).ok()?;
    Some((name.split('/').next_back().filter(|l| *l != "rgb").unwrap_or(name).to_owned(), grey))
}

/// Each pixel the mean of those that it covers.
fn resized(picture: &GreyImage, width: usize, height: usize) -> GreyImage {
    let mut out = GreyImage::new(width, height);
    for y in 0..height {
        let rows =
            y * picture.height / height..((y + 1) * picture.height / height).max(y * picture.height / height + 1);
        for x in 0..width {
            let columns =
                x * picture.width / width..((x + 1) * picture.width / width).max(x * picture.width / width + 1);
            let (mut sum, mut n) = (0, 0);
            for row in rows.clone() {
                for &p in &picture.row(row)[columns.clone()] {
                    sum += u32::from(p);
                    n += 1;
                }
            }
            out.data[y * width + x] = ((sum + n / 2) / n) as u8;
        }
    }
    out
}
