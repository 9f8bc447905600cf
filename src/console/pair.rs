//! Two pictures of the robot's camera through the two-picture chain: taken by `cairn watch --picture` and reconstructed by `cairn twoview`, as processes of
//! their own, so that what the page shows is what the terminal shows, and what it costs is bounded.

use std::fs::{self, DirBuilder, File};
use std::io::Read;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use serde::Deserialize;

use super::commands::quoted;
use crate::client::monotonic_ns;
use crate::messages::DEFAULT_PREFIX;

/// How long a picture is waited for, s; its process at the longest, with what it asks for the lens; and the chain.
const PICTURE_S: &str = "5";
const TAKING_TIME: Duration = Duration::from_secs(15);
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

/// The words of a terminal, in the folder of the pictures.
fn taking(which: Which, prefix: &str) -> Vec<String> {
    let mut words: Vec<String> = vec!["watch".into()];
    if prefix != DEFAULT_PREFIX {
        words.extend(["--prefix".into(), prefix.into()]);
    }
    words.extend(["--picture".into(), format!("{}.png", which.name()), "--camera".into(), "camera.txt".into()]);
    words
}

impl Which {
    /// The same on a terminal.
    pub fn terminal(self, prefix: &str) -> String {
        taking(self, prefix).into_iter().fold("cairn".into(), |line, word| format!("{line} {}", quoted(&word)))
    }
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

    /// Takes a picture of the daemon with this prefix and keeps it; its PNG. The lens of that daemon at that moment is kept with it.
    pub fn take(&self, which: Which, prefix: &str) -> Result<Vec<u8>, String> {
        if !self.made.load(Ordering::Relaxed) {
            let made = DirBuilder::new().mode(0o700).create(&self.folder);
            made.map_err(|e| format!("{}: {e}", self.folder.display()))?;
            self.made.store(true, Ordering::Relaxed);
        }
        let mut words = taking(which, prefix);
        words.extend(["--timeout", PICTURE_S].map(String::from));
        let (taken, said) = self.run(&words, TAKING_TIME)?;
        if !taken {
            let why = said.lines().last().unwrap_or("no picture was taken");
            return Err(why.strip_prefix("cairn: ").unwrap_or(why).into());
        }
        let path = self.folder.join(format!("{}.png", which.name()));
        picture(&path).ok_or_else(|| format!("{} cannot be read, or is too large", path.display()))
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
        // Its exit code says what its text says.
        let (_, text) = self.run(&arguments(method, has_camera), CHAIN_TIME)?;
        let pictures = STEPS.iter().filter_map(|step| Some((*step, picture(&out.join(format!("{step}.png")))?)));
        Ok(Done { text, pictures: pictures.collect(), terminal: method.terminal(has_camera) })
    }

    /// This program with these words, in the folder of the pictures; whether it went well, and what it said.
    fn run(&self, words: &[String], limit: Duration) -> Result<(bool, String), String> {
        let program = std::env::current_exe().map_err(|e| format!("this program is not found: {e}"))?;
        let log = self.folder.join("said.txt");
        let said = File::create(&log).and_then(|file| Ok((file.try_clone()?, file)));
        let (stdout, stderr) = said.map_err(|e| format!("{}: {e}", log.display()))?;
        let child = Command::new(program)
            .args(words)
            // The words name the daemon, or it is the default one.
            .env_remove("CAIRN_PREFIX")
            .current_dir(&self.folder)
            .stdin(Stdio::null())
            .stdout(stdout)
            .stderr(stderr)
            .spawn()
            .map_err(|e| format!("cairn {} cannot be started: {e}", words[0]))?;
        let went_well = wait(child, limit)?;
        fs::read_to_string(&log).map(|text| (went_well, text)).map_err(|e| format!("{}: {e}", log.display()))
    }
}

fn wait(mut child: Child, limit: Duration) -> Result<bool, String> {
    let start = Instant::now();
    loop {
        match child.try_wait() {
            Ok(Some(status)) => return Ok(status.success()),
            Ok(None) if start.elapsed() < limit => std::thread::sleep(Duration::from_millis(20)),
            _ => {
                let _ = child.kill();
                let _ = child.wait();
                return Err(format!("it took longer than {} s and was ended", limit.as_secs()));
            }
        }
    }
}

fn picture(path: &Path) -> Option<Vec<u8>> {
    let mut bytes = Vec::new();
    File::open(path).ok()?.take(MAX_PICTURE).read_to_end(&mut bytes).ok()?;
    (!bytes.is_empty()).then_some(bytes)
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
    fn a_picture_is_taken_by_a_line_of_the_terminal() {
        assert_eq!(Which::A.terminal("cairn"), "cairn watch --picture a.png --camera camera.txt");
        assert_eq!(Which::B.terminal("left"), "cairn watch --prefix left --picture b.png --camera camera.txt");
    }

    #[test]
    fn without_pictures_there_is_nothing_to_do() {
        let method = Method { detector: Detector::Fast, matcher: Matcher::Flow, guided: false };
        assert_eq!(Pair::new().reconstruct(method).expect_err("no pictures"), "take picture A first");
    }
}
