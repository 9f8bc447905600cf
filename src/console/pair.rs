//! Two pictures of the robot's camera through the two-picture chain: taken by a click, reconstructed by `cairn twoview` as a process of its own,
//! so that what the page shows is what the terminal shows, and what it costs is bounded.

use std::fs::{self, DirBuilder, File};
use std::io::{BufWriter, Read};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use serde::Deserialize;

use super::picture::{Grey, grey};
use crate::client::{Client, monotonic_ns};

/// How long a picture is waited for, and the chain at the longest.
const PICTURE_TIME: Duration = Duration::from_secs(3);
const CHAIN_TIME: Duration = Duration::from_secs(120);
/// Largest picture of a step that is sent, bytes.
const MAX_PICTURE: u64 = 8 << 20;
/// Pictures that the chain leaves, in the order of its steps.
pub const STEPS: [&str; 8] =
    ["corners_a", "corners_b", "attributes", "matches", "epipolar", "motions", "distances", "scene"];

/// Which of the two.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Which {
    A,
    B,
}

impl Which {
    pub fn name(self) -> &'static str {
        match self {
            Self::A => "a",
            Self::B => "b",
        }
    }
}

/// As `cairn twoview` names them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Detector {
    Fast,
    Susan,
    SusanStudy,
    #[serde(rename = "susan-41")]
    Susan41,
}

/// As `cairn twoview` names them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Matcher {
    Descriptors,
    Gradients,
    Attributes,
    Correlation,
    Flow,
}

/// Steps that can be chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Method {
    pub detector: Detector,
    pub matcher: Matcher,
    pub guided: bool,
}

impl Method {
    fn words(self) -> [&'static str; 2] {
        let detector = match self.detector {
            Detector::Fast => "fast",
            Detector::Susan => "susan",
            Detector::SusanStudy => "susan-study",
            Detector::Susan41 => "susan-41",
        };
        let matcher = match self.matcher {
            Matcher::Descriptors => "descriptors",
            Matcher::Gradients => "gradients",
            Matcher::Attributes => "attributes",
            Matcher::Correlation => "correlation",
            Matcher::Flow => "flow",
        };
        [detector, matcher]
    }

    /// The same on a terminal, in the folder of the pictures.
    pub fn terminal(self, has_camera: bool) -> String {
        format!("cairn {}", arguments(self, has_camera).join(" "))
    }
}

fn arguments(method: Method, has_camera: bool) -> Vec<String> {
    let [detector, matcher] = method.words();
    let mut words = vec!["twoview", "a.png", "b.png", "--detector", detector, "--matcher", matcher, "--output", "two"];
    if has_camera {
        words.extend(["--camera", "camera.txt"]);
    }
    if method.guided {
        words.push("--guided");
    }
    words.into_iter().map(String::from).collect()
}

/// A finished run.
#[derive(Debug)]
pub struct Done {
    /// What the chain printed.
    pub text: String,
    /// Name and PNG of each step that left one.
    pub pictures: Vec<(&'static str, Vec<u8>)>,
    pub terminal: String,
}

/// The two pictures, in a folder of this process.
#[derive(Debug)]
pub struct Pair {
    folder: PathBuf,
    /// By us: what somebody else put there is not written into.
    made: AtomicBool,
}

impl Pair {
    /// Its folder is made when the first picture is taken.
    pub fn new() -> Self {
        let name = format!("cairn-console-{}-{}", std::process::id(), monotonic_ns());
        Self { folder: std::env::temp_dir().join(name), made: AtomicBool::new(false) }
    }

    /// Takes a picture and keeps it; its PNG. The lens of `client`'s daemon at that moment is kept with it.
    pub fn take(&self, which: Which, client: &Client) -> Result<Vec<u8>, String> {
        let frame = client.frames().wait(PICTURE_TIME).map_err(|e| e.to_string())?;
        let frame = frame.ok_or("no picture has come: is the daemon running, and the camera there?")?;
        let png = grey(&frame).and_then(png).ok_or("the picture cannot be written")?;
        let fault = |e: std::io::Error| format!("{}: {e}", self.folder.display());
        if !self.made.load(Ordering::Relaxed) {
            DirBuilder::new().mode(0o700).create(&self.folder).map_err(fault)?;
            self.made.store(true, Ordering::Relaxed);
        }
        fs::write(self.folder.join(format!("{}.png", which.name())), &png).map_err(fault)?;
        let health = client.health().wait(PICTURE_TIME).map_err(|e| e.to_string())?;
        if let Some(h) =
            health.filter(|h| h.focal_px[0].is_finite() && h.lens_model == crate::messages::LENS_RADIAL_TANGENTIAL)
        {
            let ([fx, fy], [cx, cy]) = (h.focal_px, h.centre_px);
            fs::write(self.folder.join("camera.txt"), format!("{fx} 0 {cx}\n0 {fy} {cy}\n0 0 1\n")).map_err(fault)?;
        }
        Ok(png)
    }

    /// Removes the pictures. What runs on them ends by itself.
    pub fn clear(&self) {
        if self.made.swap(false, Ordering::Relaxed) {
            let _ = fs::remove_dir_all(&self.folder);
        }
    }

    /// The whole chain on the two pictures.
    pub fn reconstruct(&self, method: Method) -> Result<Done, String> {
        for which in [Which::A, Which::B] {
            let name = format!("{}.png", which.name());
            if !self.folder.join(&name).exists() {
                return Err(format!("take picture {} first", which.name().to_uppercase()));
            }
        }
        let out = self.folder.join("two");
        // Pictures of the run before must not be taken for this one's.
        let _ = fs::remove_dir_all(&out);
        let has_camera = self.folder.join("camera.txt").exists();
        let program = std::env::current_exe().map_err(|e| format!("this program is not found: {e}"))?;
        let log = self.folder.join("said.txt");
        let said = File::create(&log).and_then(|file| Ok((file.try_clone()?, file)));
        let (stdout, stderr) = said.map_err(|e| format!("{}: {e}", log.display()))?;
        let child = Command::new(program)
            .args(arguments(method, has_camera))
            .current_dir(&self.folder)
            .stdin(Stdio::null())
            .stdout(stdout)
            .stderr(stderr)
            .spawn()
            .map_err(|e| format!("the chain cannot be started: {e}"))?;
        wait(child)?;
        let text = fs::read_to_string(&log).map_err(|e| e.to_string())?;
        let pictures = STEPS.iter().filter_map(|step| Some((*step, picture(&out.join(format!("{step}.png")))?)));
        Ok(Done { text, pictures: pictures.collect(), terminal: method.terminal(has_camera) })
    }
}

fn wait(mut child: Child) -> Result<(), String> {
    let start = Instant::now();
    loop {
        match child.try_wait() {
            // Its exit code says what its text says.
            Ok(Some(_)) => return Ok(()),
            Ok(None) if start.elapsed() < CHAIN_TIME => std::thread::sleep(Duration::from_millis(50)),
            _ => {
                let _ = child.kill();
                let _ = child.wait();
                return Err(format!("the chain took longer than {} s and was ended", CHAIN_TIME.as_secs()));
            }
        }
    }
}

fn picture(path: &Path) -> Option<Vec<u8>> {
    let mut bytes = Vec::new();
    File::open(path).ok()?.take(MAX_PICTURE).read_to_end(&mut bytes).ok()?;
    (!bytes.is_empty()).then_some(bytes)
}

fn png(picture: Grey<'_>) -> Option<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(BufWriter::new(&mut bytes), picture.width.into(), picture.height.into());
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header().ok()?;
    writer.write_image_data(&picture.pixels).ok()?;
    writer.finish().ok()?;
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_words_are_those_of_the_terminal() {
        let method: Method =
            serde_json::from_str(r#"{"detector":"susan","matcher":"attributes","guided":true}"#).expect("method");
        let words =
            "cairn twoview a.png b.png --detector susan --matcher attributes --output two --camera camera.txt --guided";
        assert_eq!(method.terminal(true), words);
        for text in [r#"{"detector":"susan; rm","matcher":"flow","guided":true}"#, r#"{"detector":"fast"}"#] {
            assert!(serde_json::from_str::<Method>(text).is_err(), "{text}");
        }
    }

    #[test]
    fn without_pictures_there_is_nothing_to_do() {
        let method = Method { detector: Detector::Fast, matcher: Matcher::Flow, guided: false };
        assert_eq!(Pair::new().reconstruct(method).expect_err("no pictures"), "take picture A first");
    }
}
