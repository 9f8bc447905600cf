//! Small recordings made in a temporary folder, one for each layout, and everything that can be wrong with one.

use super::list::{parse_asl_line, parse_tum_line};
use super::*;
use crate::image::GreyImage;
use crate::image::decode::Decoder;
use crate::trajectory::format_timestamp;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use std::fs;
use tempfile::TempDir;

const JPEG: &[u8] = include_bytes!("../../../tests/data/pictures/grey.jpg");
const PNG: &[u8] = include_bytes!("../../../tests/data/pictures/colour.png");
const CAMERA: &str = "width: 104\nheight: 72\nfx: 100\nfy: 101\ncx: 52\ncy: 36\ndistortion: [0, 0, 0, 0, 0]\n";
const NO_WAIT: Duration = Duration::ZERO;

/// A recording in TUM RGB-D layout with the given list; the pictures 0.png (JPEG inside), 1.png and 2.jpg are there.
fn tum(list: &str) -> TempDir {
    let dir = tempfile::tempdir().expect("temporary folder");
    fs::create_dir(dir.path().join("rgb")).expect("made");
    for (name, bytes) in [("0.png", JPEG), ("1.png", PNG), ("2.jpg", JPEG)] {
        fs::write(dir.path().join("rgb").join(name), bytes).expect("written");
    }
    fs::write(dir.path().join("rgb.txt"), list).expect("written");
    fs::write(dir.path().join("camera.yaml"), CAMERA).expect("written");
    dir
}

const LIST: &str = "# color images\n# timestamp filename\n1305031102.175304 rgb/0.png\r\n\n1305031102.211214 rgb/1.png\n1305031102.243211\trgb/2.jpg";

fn open(dir: &TempDir) -> Recording {
    Recording::open(dir.path(), Pacing::LockStep).expect("a recording")
}

fn open_error(folder: &Path) -> String {
    Recording::open(folder, Pacing::LockStep).expect_err("no recording").to_string()
}

/// Everything that a source gives, at most 100 grabs.
fn drain(source: &mut dyn FrameSource) -> Vec<(Grab, RawFrame)> {
    let mut slot = RawFrame::default();
    let mut all = Vec::new();
    for _ in 0..100 {
        match source.grab(&mut slot, NO_WAIT).expect("goes on") {
            Grab::End => return all,
            grab => all.push((grab, slot.clone())),
        }
    }
    panic!("does not end");
}

fn skip_reasons(all: &[(Grab, RawFrame)]) -> Vec<&str> {
    all.iter()
        .filter_map(|(g, _)| if let Grab::Skipped { reason } = g { Some(reason.as_str()) } else { None })
        .collect()
}

#[test]
fn a_tum_folder_gives_its_files_bytes_with_exact_timestamps() {
    let dir = tum(LIST);
    let mut recording = open(&dir);
    let before = monotonic_ns();
    let all = drain(&mut recording);
    let expected = [
        (1_305_031_102_175_304_000, PixelFormat::Jpeg, JPEG),
        (1_305_031_102_211_214_000, PixelFormat::Png, PNG),
        (1_305_031_102_243_211_000, PixelFormat::Jpeg, JPEG),
    ];
    assert_eq!(all.len(), 3);
    let mut image = GreyImage::default();
    for (i, ((grab, frame), (timestamp_ns, format, bytes))) in all.iter().zip(expected).enumerate() {
        assert_eq!(
            (grab, frame.sequence, frame.timestamp_ns, frame.format),
            (&Grab::Frame, i as u64, timestamp_ns, format)
        );
        assert_eq!(frame.data, bytes);
        assert!(frame.arrival_ns >= before);
        Decoder::default().decode(frame, &mut image).expect("decodes");
        assert_eq!((image.width, image.height), (104, 72));
    }
    assert_eq!(recording.grab(&mut RawFrame::default(), NO_WAIT).expect("still"), Grab::End);
}

#[test]
fn the_description_says_what_is_known_before_the_first_frame() {
    let recording = open(&tum(LIST));
    let d = recording.description();
    assert_eq!((d.size, d.clock, d.frames), (Some((104, 72)), Clock::Recording, Some(3)));
    let camera = d.camera.as_ref().expect("camera.yaml is there");
    assert_eq!((camera.width, camera.fy), (104, 101.0));
    assert!((d.rate_hz.expect("two steps") - 1e9 / 35_910_000.0).abs() < 1e-9);
}

#[test]
fn an_asl_folder_is_found_from_each_of_its_levels() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let cam0 = dir.path().join("mav0/cam0");
    fs::create_dir_all(cam0.join("data")).expect("made");
    fs::write(cam0.join("data/1403636579763555584.png"), PNG).expect("written");
    fs::write(cam0.join("data.csv"), "#timestamp [ns],filename\r\n1403636579763555584,1403636579763555584.png\r\n")
        .expect("written");
    fs::write(
        cam0.join("sensor.yaml"),
        "resolution: [104, 72]\nintrinsics: [100, 101, 52, 36]\ndistortion_coefficients: [0.1, 0, 0, 0]\n",
    )
    .expect("written");
    for folder in [dir.path().to_path_buf(), dir.path().join("mav0"), cam0] {
        let mut recording = Recording::open(&folder, Pacing::LockStep).expect("a recording");
        assert_eq!(recording.description().camera.as_ref().expect("sensor.yaml").lens.coefficients()[0], 0.1);
        let all = drain(&mut recording);
        assert_eq!((&all[0].0, all[0].1.timestamp_ns, all.len()), (&Grab::Frame, 1_403_636_579_763_555_584, 1));
        assert_eq!(recording.timestamp_text(1_403_636_579_763_555_584), Some("1403636579763555584"));
    }
}

#[test]
fn the_very_digits_of_the_list_come_back() {
    let list = "10.5 rgb/0.png\n9.250 rgb/1.png\n11 rgb/2.jpg\n1305031102.175304 rgb/2.jpg\n";
    let recording = open(&tum(list));
    for (frame, text) in recording.frames().iter().zip(["10.5", "9.250", "11", "1305031102.175304"]) {
        assert_eq!(recording.timestamp_text(frame.timestamp_ns), Some(text));
    }
    assert_eq!(recording.timestamp_text(12), None);
}

#[test]
fn the_trajectory_writers_digits_are_those_of_the_sequences() {
    let root = std::env::var_os("CAIRN_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    for name in ["tum_fr1_xyz", "7scenes_redkitchen", "visp_rbt", "new_tsukuba", "uzh_parking"] {
        if !root.join(name).is_dir() {
            println!("skipped: {} is not here", root.join(name).display());
            continue;
        }
        let recording = Recording::open(&root.join(name), Pacing::LockStep).expect("a recording");
        assert_eq!(recording.description().size, Some((640, 480)));
        for frame in recording.frames() {
            assert_eq!(format_timestamp(frame.timestamp_ns), &*frame.timestamp_text, "{name}");
        }
    }
}

#[test]
fn timestamps_that_repeat_or_go_back_are_skipped_and_counted() {
    let dir = tum("2.0 rgb/0.png\n2.0 rgb/1.png\n1.5 rgb/1.png\n3.0 rgb/2.jpg\n");
    let all = drain(&mut open(&dir));
    let given: Vec<_> =
        all.iter().filter(|(g, _)| *g == Grab::Frame).map(|(_, f)| (f.sequence, f.timestamp_ns)).collect();
    assert_eq!(given, [(0, 2_000_000_000), (3, 3_000_000_000)]);
    let reasons = skip_reasons(&all);
    assert!(reasons[0].contains("timestamp 2.0 s repeats") && reasons[1].contains("1.5 s goes back"), "{reasons:?}");
}

#[test]
fn unreadable_pictures_are_skipped_with_the_reason_and_the_rest_goes_on() {
    let dir = tum("1 rgb/none.png\n2 rgb/folder\n3 rgb/empty.png\n4 rgb/text.png\n5 rgb/long.png\n6 rgb/2.jpg\n");
    fs::create_dir(dir.path().join("rgb/folder")).expect("made");
    fs::write(dir.path().join("rgb/empty.png"), "").expect("written");
    fs::write(dir.path().join("rgb/text.png"), "not a picture").expect("written");
    fs::File::create(dir.path().join("rgb/long.png")).and_then(|f| f.set_len(1 << 30)).expect("sparse file");
    let all = drain(&mut open(&dir));
    let reasons = skip_reasons(&all);
    assert_eq!(reasons.len(), 5);
    for (reason, expected) in
        reasons.iter().zip(["No such file", "is not a file", "0 bytes", "neither JPEG nor PNG", "more than"])
    {
        assert!(reason.contains(expected), "{reason}");
    }
    assert_eq!((&all[5].0, all[5].1.sequence), (&Grab::Frame, 5));
}

#[cfg(unix)]
#[test]
fn a_pipe_in_place_of_a_picture_does_not_block() {
    let dir = tum("1 rgb/pipe\n2 rgb/2.jpg\n");
    let made = std::process::Command::new("mkfifo").arg(dir.path().join("rgb/pipe")).status();
    if !made.is_ok_and(|s| s.success()) {
        println!("skipped: no mkfifo");
        return;
    }
    let all = drain(&mut open(&dir));
    assert!(skip_reasons(&all)[0].contains("is not a file"));
    assert_eq!(all[1].0, Grab::Frame);
}

#[test]
fn what_is_no_recording_is_named_with_the_reason() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let path = dir.path();
    assert!(open_error(&path.join("missing")).contains("missing: No such file"));
    assert!(open_error(path).ends_with("the folder is empty"));
    fs::write(path.join("note.md"), "").expect("written");
    assert!(open_error(path).contains("neither rgb.txt (TUM RGB-D layout) nor mav0/cam0/data.csv"));
    assert!(open_error(&path.join("note.md")).contains("is not a folder"));
    fs::write(path.join("rgb.txt"), "# nothing\n\n").expect("written");
    assert!(open_error(path).contains("rgb.txt: lists no frames"));
    fs::write(path.join("rgb.txt"), [0xff, 0xfe, 0x00]).expect("written");
    assert!(open_error(path).contains("rgb.txt: is not UTF-8"));
}

#[test]
fn a_malformed_line_is_named_with_its_number() {
    for (line, expected) in [
        ("1.0", "rgb.txt:3: must be 'timestamp filename', not \"1.0\""),
        ("1.0 a b", "must be 'timestamp filename'"),
        ("one a.png", "timestamp \"one\" is not a decimal number of seconds"),
        ("1403636579763555584 a.png", "are these nanoseconds?"),
    ] {
        let message = open_error(tum(&format!("# list\n0.5 rgb/0.png\n{line}\n")).path());
        assert!(message.contains(expected), "{message}");
    }
}

#[test]
fn a_wrong_calibration_is_an_error_unless_another_is_used() {
    let dir = tum(LIST);
    fs::write(dir.path().join("camera.yaml"), CAMERA.replace("fx: 100", "fx: -100")).expect("written");
    let message = open_error(dir.path());
    assert!(message.contains("camera.yaml:3: fx = -100 px: must be greater than 0"), "{message}");
    let recording = Recording::open_with(dir.path(), Pacing::LockStep, OwnCalibration::Ignore).expect("a recording");
    assert_eq!(recording.description().camera, None);
    fs::remove_file(dir.path().join("camera.yaml")).expect("removed");
    assert_eq!(open(&dir).description().camera, None);
}

const MS: i64 = 1_000_000;

#[test]
fn frames_are_due_as_long_after_the_first_as_their_timestamps_say() {
    let mut pacer = Pacer::new(Some(33 * MS));
    assert_eq!(pacer.due_ns(5_000 * MS, 100 * MS), 100 * MS);
    pacer.gave(5_000 * MS, 100 * MS);
    for k in 1..50 {
        let due = pacer.due_ns((5_000 + 33 * k) * MS, 0);
        assert_eq!(due, (100 + 33 * k) * MS);
        // Small lateness does not add up.
        pacer.gave((5_000 + 33 * k) * MS, due + (k % 9) * MS);
    }
}

#[test]
fn after_a_stall_the_rest_is_played_later_and_not_in_a_burst() {
    let mut pacer = Pacer::new(Some(33 * MS));
    pacer.gave(0, 0);
    pacer.gave(33 * MS, 5_000 * MS);
    assert_eq!(pacer.due_ns(66 * MS, 5_000 * MS), 5_033 * MS);
}

#[test]
fn a_jump_of_the_timestamps_is_not_waited_out() {
    let mut pacer = Pacer::new(Some(33 * MS));
    pacer.gave(0, 0);
    assert_eq!(pacer.due_ns(3_600_000 * MS, 0), MAX_GAP_NS);
    assert_eq!(pacer.due_ns(i64::MAX, 0), MAX_GAP_NS);
    let mut negative = Pacer::new(None);
    negative.gave(i64::MIN, 0);
    assert_eq!(negative.due_ns(i64::MAX, 0), MAX_GAP_NS);
}

#[test]
fn in_real_time_no_frame_comes_before_it_is_due_and_a_time_out_leaves_the_slot_alone() {
    let dir = tum("0.000 rgb/0.png\n0.120 rgb/1.png\n");
    let mut recording = Recording::open(dir.path(), Pacing::RealTime).expect("a recording");
    let mut slot = RawFrame::default();
    let start = monotonic_ns();
    assert_eq!(recording.grab(&mut slot, NO_WAIT).expect("first"), Grab::Frame);
    // How late a busy machine is proves nothing, so only the lower bound is held.
    for _ in 0..1_000 {
        match recording.grab(&mut slot, Duration::from_millis(10)).expect("goes on") {
            Grab::TimedOut => assert_eq!(slot.sequence, 0),
            grab => {
                assert_eq!((grab, slot.sequence), (Grab::Frame, 1));
                assert!(slot.arrival_ns - start >= 120 * MS);
                return;
            }
        }
    }
    panic!("the second frame never came");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2_000, rng_seed: RngSeed::Fixed(5), failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_line_panics_and_what_is_accepted_keeps_its_text(line in "[-+0-9.,eE# a\u{e9}\t]{0,40}|\\PC{0,40}") {
        for parsed in [parse_tum_line(line.trim()), parse_asl_line(line.trim())].into_iter().flatten() {
            prop_assert!(line.contains(&*parsed.timestamp_text) && line.contains(&*parsed.file));
        }
    }

    #[test]
    fn six_and_nine_decimals_round_trip_through_a_line(seconds in 0u32..2_000_000_000, micros in 0u32..1_000_000) {
        let text = format!("{seconds}.{micros:06}");
        let frame = parse_tum_line(&format!("{text} a.png")).expect("well-formed");
        prop_assert_eq!(format_timestamp(frame.timestamp_ns), text);
    }
}
