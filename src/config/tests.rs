use super::*;

/// The documented example that is installed as the default configuration.
const EXAMPLE: &str = include_str!("../../config/cairn.toml");

fn refused(text: &str) -> String {
    parse(text, "robot.toml").expect_err("must be refused").to_string()
}

/// All dotted keys of a TOML value that hold no table.
fn leaves(value: &toml::Value, path: &str, out: &mut Vec<String>) {
    match value {
        toml::Value::Table(table) => {
            for (key, inner) in table {
                leaves(inner, &if path.is_empty() { key.clone() } else { format!("{path}.{key}") }, out);
            }
        }
        _ => out.push(path.into()),
    }
}

#[test]
fn an_empty_file_is_the_default() {
    assert_eq!(parse("", "robot.toml"), Ok(Config::default()));
    assert_eq!(Config::default().validate(), Ok(()));
}

#[test]
fn the_example_file_is_the_default() {
    assert_eq!(parse(EXAMPLE, "config/cairn.toml"), Ok(Config::default()));
}

#[test]
fn the_example_file_shows_every_key() {
    let mut all = Vec::new();
    leaves(&toml::Value::try_from(Config::default()).expect("the default is TOML"), "", &mut all);
    let mut shown = Vec::new();
    leaves(&EXAMPLE.parse::<toml::Table>().map(toml::Value::Table).expect("TOML"), "", &mut shown);
    let missing: Vec<_> = all.iter().filter(|key| !shown.contains(key)).collect();
    assert!(missing.is_empty(), "config/cairn.toml does not show {missing:?}");
    assert!(shown.len() > 10);
}

#[test]
fn every_key_of_the_example_is_explained_by_a_comment_above_it() {
    let mut explained = false;
    for (i, line) in EXAMPLE.lines().enumerate() {
        if line.starts_with('#') {
            explained = true;
        } else if line.contains('=') {
            assert!(explained, "config/cairn.toml:{}: no comment explains `{line}`", i + 1);
        } else {
            // A blank line or a section's head: what was said before does not speak of what follows.
            explained = false;
        }
    }
}

#[test]
fn a_typo_names_file_line_key_and_what_is_meant() {
    let message = refused("prefix = \"left\"\n\n[features]\ndetectr = \"fast\"\n");
    assert!(message.starts_with("robot.toml:4: features.detectr = \"fast\": "), "{message}");
    assert!(message.contains("`detector` is meant"), "{message}");
}

#[test]
fn a_wrong_unit_is_answered_with_the_right_one() {
    let message = refused("[daemon]\nstall_after_s = 3\n");
    assert!(message.starts_with("robot.toml:2: daemon.stall_after_s = 3 s: "), "{message}");
    assert!(message.contains("`stall_after_ms` is meant"), "{message}");
}

#[test]
fn an_unknown_section_is_refused() {
    let message = refused("[recontruction]\n");
    assert!(message.contains("robot.toml:1: recontruction"), "{message}");
    assert!(message.contains("`reconstruction` is meant"), "{message}");
    let message = refused("[weather]\nrain = true\n");
    assert!(message.contains("known here: prefix, "), "{message}");
}

#[test]
fn an_impossible_value_names_its_unit_and_range() {
    let message = refused("[daemon]\n# patience\nstall_after_ms = 5\n");
    assert_eq!(message, "robot.toml:3: daemon.stall_after_ms = 5 ms: must be 100 to 60000");
}

#[test]
fn a_value_of_another_type_is_refused_at_its_line() {
    let message = refused("[daemon]\nqueue_frames = \"two\"\n");
    assert!(message.starts_with("robot.toml:2: daemon.queue_frames = \"two\" frames: invalid type"), "{message}");
    let message = refused("[features]\ndetector = \"harris\"\n");
    assert!(message.contains("unknown variant `harris`, expected"), "{message}");
}

#[test]
fn a_fault_of_syntax_names_its_line() {
    let message = refused("[daemon]\nqueue_frames = = 2\n");
    assert!(message.starts_with("robot.toml:2: "), "{message}");
    let message = refused("[daemon]\nqueue_frames = 1\nqueue_frames = 2\n");
    assert!(message.starts_with("robot.toml:3: ") && message.contains("duplicate"), "{message}");
}

#[test]
fn a_refused_mount_is_found_inside_its_inline_table() {
    let message =
        refused("[mount]\nbody_from_camera = { translation_m = [0, 0, 0], quaternion_xyzw = [0, 0, 0, 3] }\n");
    assert_eq!(
        message,
        "robot.toml:2: mount.body_from_camera.quaternion_xyzw = [0, 0, 0, 3]: must have length 1, has 3"
    );
}

#[test]
fn prefixes_that_cannot_be_service_names_are_refused() {
    for prefix in ["", "two words", "käfer", &"x".repeat(65)] {
        assert!(parse(&format!("prefix = \"{prefix}\""), "f").is_err(), "{prefix}");
    }
    assert!(parse("prefix = \"robot-1/left.cam_0\"", "f").is_ok());
}

#[test]
fn a_missing_file_is_named() {
    let error = load(Path::new("/nonexistent/robot.toml")).expect_err("no such file");
    assert!(error.to_string().starts_with("/nonexistent/robot.toml: "), "{error}");
}

#[test]
fn units_are_read_from_the_end_of_the_key() {
    for (key, unit) in [("a.b_px", Some("px")), ("v_m_s", Some("m/s")), ("x_m", Some("m")), ("detector", None)] {
        assert_eq!(error::unit(key), unit, "{key}");
    }
}

#[test]
fn both_builds_check_the_simulators_keys_and_the_robots_refuses_only_what_it_cannot_do() {
    assert!(parse("[simulator]\nscenario = \"corridor\"\n[simulator.noise]\nread_sigma = 3.0\n", "f").is_ok());
    let message = refused("[simulator]\nscenrio = \"corridor\"\n");
    assert!(message.contains("`scenario` is meant"), "{message}");
    let message = refused("[simulator]\nrate_hz = 1000.0\n");
    assert!(message.starts_with("robot.toml:2: simulator.rate_hz = 1000.0 Hz: "), "{message}");
    for (text, key) in [
        ("[daemon]\nsource = \"simulator\"\n", "daemon.source = \"simulator\""),
        ("[output]\noverview = \"map.png\"\n", "output.overview = \"map.png\""),
    ] {
        let outcome = parse(text, "robot.toml");
        assert_eq!(outcome.is_ok(), cfg!(feature = "tools"), "{key}");
        if let Err(error) = outcome {
            let message = error.to_string();
            assert!(message.starts_with(&format!("robot.toml:2: {key}: ")), "{message}");
            assert!(message.contains("cairn-tools"), "{message}");
        }
    }
}
