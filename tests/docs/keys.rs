//! Keys of the configuration as the pages name them: `[section] key`, `section.key`, blocks of TOML, and the page of all keys.

use std::collections::BTreeMap;

use cairn::config::Config;
use toml::Value;

/// Every key with its default, by its dotted path.
pub fn defaults() -> BTreeMap<String, Value> {
    let mut found = BTreeMap::new();
    collect("", &Value::try_from(Config::default()).expect("the default is TOML"), &mut found);
    found
}

/// The mount's inline table is one value.
fn collect(path: &str, value: &Value, found: &mut BTreeMap<String, Value>) {
    match value {
        Value::Table(table) if path != "mount.body_from_camera" => {
            for (key, inner) in table {
                let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                collect(&path, inner, found);
            }
        }
        _ => {
            found.insert(path.to_owned(), value.clone());
        }
    }
}

/// The key or section that a code span names, dotted.
pub fn named(span: &str) -> Option<String> {
    let name = span.split(" = ").next().unwrap_or(span);
    let is_path =
        |text: &str| !text.is_empty() && text.chars().all(|c| c.is_ascii_lowercase() || matches!(c, '_' | '.'));
    if let Some((section, key)) = name.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        let key = key.trim();
        return match (is_path(section), key.is_empty()) {
            (false, _) => None,
            (true, true) => Some(section.to_owned()),
            (true, false) => is_path(key).then(|| format!("{section}.{key}")),
        };
    }
    let (section, key) = name.split_once('.')?;
    let sections = Value::try_from(Config::default()).expect("the default is TOML");
    let known = sections.get(section).is_some_and(Value::is_table);
    let file = ["toml", "yaml", "yml", "txt", "png", "md", "rs"].contains(&key);
    (known && !file && is_path(key)).then(|| name.to_owned())
}

/// Whether there is such a key or section. The mount's angles have no default, so the default does not show them.
pub fn exists(name: &str) -> bool {
    let inside = format!("{name}.");
    defaults().keys().any(|key| key == name || key.starts_with(&inside)) || {
        let mount = ["translation_m", "rpy_deg", "quaternion_xyzw"];
        name.strip_prefix("mount.body_from_camera.").is_some_and(|key| mount.contains(&key))
    }
}

/// Unit that the end of a key's name stands for.
fn unit(key: &str) -> Option<&'static str> {
    let units = [
        ("_px", "px"),
        ("_ms", "ms"),
        ("_hz", "Hz"),
        ("_s", "s"),
        ("_mm", "mm"),
        ("_m", "m"),
        ("_deg", "degrees"),
        ("_bytes", "bytes"),
        ("_frames", "frames"),
        ("_widths", "picture widths"),
        ("_ev", "EV"),
        ("_m_s", "m/s"),
        ("_deg_s", "degrees/s"),
    ];
    // The longest end wins: `_m_s` is not `_s`.
    units.iter().filter(|(end, _)| key.ends_with(end)).max_by_key(|(end, _)| end.len()).map(|(_, unit)| *unit)
}

/// Equal, numbers to the precision that the configuration keeps of them.
fn same(shown: &Value, default: &Value) -> bool {
    match (shown, default) {
        (Value::Float(a), Value::Float(b)) => (a - b).abs() <= 1e-6 * b.abs(),
        (Value::Array(a), Value::Array(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| same(a, b)),
        _ => shown == default,
    }
}

/// What is wrong with a page that lists every key: rows `| `key` | `default` | unit |` under headings `### [section]`.
pub fn faults_of_list(page: &str) -> Vec<String> {
    let mut left = defaults();
    let mut faults = Vec::new();
    let mut section = String::new();
    for line in page.lines() {
        if let Some(title) = line.strip_prefix("### [").and_then(|rest| rest.strip_suffix(']')) {
            section = format!("{title}.");
        }
        let cells: Vec<_> = line.split('|').map(|cell| cell.trim().trim_matches('`')).collect();
        let ["", key, shown, told, ..] = cells[..] else { continue };
        if key == "key" || key.starts_with("---") {
            continue;
        }
        let name = format!("{section}{key}");
        let Some(default) = left.remove(&name) else {
            faults.push(format!("`{name}` is no key, or is listed twice"));
            continue;
        };
        match toml::from_str::<toml::Table>(&format!("value = {shown}")) {
            Ok(table) if same(&table["value"], &default) => {}
            _ => faults.push(format!("`{name}` has the default {default}, not {shown}")),
        }
        if unit(key).is_some_and(|unit| unit != told) {
            faults.push(format!("`{name}` is in {}, not in {told:?}", unit(key).unwrap_or_default()));
        }
    }
    faults.extend(left.into_keys().map(|key| format!("`{key}` is not listed")));
    faults
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spans_that_name_a_key_are_told_from_others() {
        for (span, name) in [
            ("[camera] rate_hz = 30.0", "camera.rate_hz"),
            ("[simulator.lens.wide_angle] enabled", "simulator.lens.wide_angle.enabled"),
            ("[mount]", "mount"),
            ("log.level = \"info\"", "log.level"),
            ("camera.wdth_px", "camera.wdth_px"),
        ] {
            assert_eq!(named(span).as_deref(), Some(name), "{span}");
        }
        for span in ["camera.toml", "[0, 0, 0]", "[u8; 2]", "pose.position", "cairn run", "[--json]", "log"] {
            assert_eq!(named(span), None, "{span}");
        }
    }

    #[test]
    fn keys_that_are_not_there_are_found() {
        assert!(exists("camera.rate_hz") && exists("simulator.lens") && exists("prefix"));
        assert!(exists("mount.body_from_camera.rpy_deg") && exists("mount.body_from_camera"));
        for wrong in ["camera.wdth_px", "camra", "camera.rate", "mount.rpy_deg"] {
            assert!(!exists(wrong), "{wrong}");
        }
    }

    #[test]
    fn a_list_must_have_every_key_with_its_default_and_unit() {
        let row = |key: &str, value: &Value, unit: &str| format!("| `{key}` | `{value}` | {unit} |\n");
        let mut page = String::new();
        for (name, value) in defaults() {
            let (section, key) = name.rsplit_once('.').unwrap_or(("", &name));
            let title = if section.is_empty() { String::new() } else { format!("### [{section}]\n") };
            // A key outside any section comes first on a page.
            let rows = format!("{title}{}", row(key, &value, unit(key).unwrap_or("")));
            page = if section.is_empty() { rows + &page } else { page + &rows };
        }
        assert_eq!(faults_of_list(&page), [""; 0]);
        let wrong = page
            .replace("| `rate_hz` | `30.0` | Hz |", "| `rate_hz` | `25.0` | s |")
            .replace("| `queue_frames` |", "| `queue` |");
        let faults = faults_of_list(&wrong).join("; ");
        for word in [
            "camera.rate_hz` has the default 30",
            "camera.rate_hz` is in Hz",
            "`daemon.queue` is no key",
            "`daemon.queue_frames` is not listed",
        ] {
            assert!(faults.contains(word), "{word} is not in {faults}");
        }
    }
}
