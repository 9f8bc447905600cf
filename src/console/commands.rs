//! What a page may have the daemon do: the commands of `cairn command` and `cairn map`, and each as it is typed there.

use std::time::Duration;

use serde::Deserialize;

use crate::client::{Client, StoredMap};
use crate::messages::{CameraControl, CommandReply, DEFAULT_PREFIX, Transform, reply_code};

/// How long the daemon may take; saving a large map takes seconds.
const PATIENCE: Duration = Duration::from_secs(30);

/// A button.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum Action {
    /// With braces, as serde would let unknown fields of a bare variant pass.
    Reset {},
    SaveTrajectory {
        path: String,
    },
    SaveMap {
        path: String,
    },
    /// Map units and degrees, counter-clockwise from above.
    SetPose {
        x: f64,
        y: f64,
        yaw_deg: f64,
    },
    /// An empty name: the map's own file.
    StoreMap {
        name: String,
    },
    LoadMap {
        name: String,
    },
    NewMap {
        name: String,
    },
    LocaliseOnly {
        on: bool,
    },
    ListMaps {},
    /// Its answer is the daemon's: a line a control.
    CameraControls {},
    /// `exposure`, `gain` or `focus`; `None`: the camera decides.
    SetCamera {
        control: String,
        value: Option<f64>,
    },
}

impl Action {
    /// The same on a terminal.
    pub fn terminal(&self, prefix: &str) -> String {
        let prefix = if prefix == DEFAULT_PREFIX { String::new() } else { format!(" --prefix {}", quoted(prefix)) };
        let of_map = |what: &str| format!("cairn map{prefix} {what}");
        let what = match self {
            Self::StoreMap { name } if name.is_empty() => return of_map("save"),
            Self::StoreMap { name } => return of_map(&format!("save {}", quoted(name))),
            Self::LoadMap { name } => return of_map(&format!("load {}", quoted(name))),
            Self::NewMap { name } => return of_map(&format!("new {}", quoted(name))),
            Self::LocaliseOnly { on } => return of_map(if *on { "localise on" } else { "localise off" }),
            Self::ListMaps {} => return of_map("list"),
            Self::Reset {} => "reset".into(),
            Self::SaveTrajectory { path } => format!("save-trajectory {}", quoted(path)),
            Self::SaveMap { path } => format!("save-map {}", quoted(path)),
            Self::SetPose { x, y, yaw_deg } => format!("set-pose {x} {y} {yaw_deg}"),
            Self::CameraControls {} => "camera".into(),
            Self::SetCamera { control, value: Some(value) } => format!("camera {} {value}", quoted(control)),
            Self::SetCamera { control, value: None } => format!("camera {} auto", quoted(control)),
        };
        format!("cairn command{prefix} {what}")
    }

    /// Sends it and waits; the sentence says what became of it, or why it failed.
    pub fn carry_out(&self, client: &Client) -> Result<String, String> {
        if let Self::SaveTrajectory { path } | Self::SaveMap { path } = self
            && !path.starts_with('/')
        {
            return Err(format!("{path:?} is no absolute path; the daemon has a working folder of its own"));
        }
        let reply = match self {
            Self::Reset {} => client.reset(PATIENCE),
            Self::SaveTrajectory { path } => client.save_trajectory(path, PATIENCE),
            Self::SaveMap { path } => client.save_map(path, PATIENCE),
            Self::SetPose { x, y, yaw_deg } => {
                client.set_pose(&Transform::level(*x, *y, yaw_deg.to_radians()), PATIENCE)
            }
            Self::StoreMap { name } => client.store_map(Some(name.as_str()).filter(|name| !name.is_empty()), PATIENCE),
            Self::LoadMap { name } => client.load_map(name, PATIENCE),
            Self::NewMap { name } => client.new_map(name, PATIENCE),
            Self::LocaliseOnly { on } => client.localise_only(*on, PATIENCE),
            Self::ListMaps {} => return list(client),
            Self::CameraControls {} => return controls(client),
            Self::SetCamera { control, value } => client.set_camera(control, *value, PATIENCE),
        };
        outcome(&reply.map_err(|e| e.to_string())?)
    }
}

/// A line a map, its name first.
fn list(client: &Client) -> Result<String, String> {
    let line = |map: StoredMap| {
        let current = if map.is_current { ", the current one" } else { "" };
        format!("{} {:.1} MB{current}", map.name, map.bytes as f64 / 1e6)
    };
    match client.all_maps(PATIENCE).map_err(|e| e.to_string())? {
        Ok(maps) if maps.is_empty() => Ok("no maps yet".into()),
        Ok(maps) => Ok(maps.into_iter().map(line).collect::<Vec<_>>().join("\n")),
        Err(refused) => Err(refused.message().into()),
    }
}

/// A line a control, as the daemon has it.
fn controls(client: &Client) -> Result<String, String> {
    match client.camera_controls(PATIENCE).map_err(|e| e.to_string())? {
        Ok(controls) => Ok(controls.iter().map(CameraControl::to_string).collect::<Vec<_>>().join("\n")),
        Err(refused) => Err(refused.message().into()),
    }
}

fn outcome(reply: &CommandReply) -> Result<String, String> {
    let message = if reply.message().is_empty() { "done" } else { reply.message() }.to_owned();
    if reply.code == reply_code::OK { Ok(message) } else { Err(message) }
}

/// A word for a shell.
pub fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "/._-+:@".contains(c);
    if !word.is_empty() && word.chars().all(plain) { word.into() } else { format!("'{}'", word.replace('\'', r"'\''")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn terminal(json: &str, prefix: &str) -> String {
        serde_json::from_str::<Action>(json).expect("action").terminal(prefix)
    }

    #[test]
    fn a_button_is_a_line_of_the_terminal() {
        assert_eq!(terminal(r#"{"do":"reset"}"#, "cairn"), "cairn command reset");
        assert_eq!(terminal(r#"{"do":"reset"}"#, "left"), "cairn command --prefix left reset");
        assert_eq!(
            terminal(r#"{"do":"save_map","path":"/tmp/it's"}"#, "cairn"),
            r"cairn command save-map '/tmp/it'\''s'"
        );
        assert_eq!(
            terminal(r#"{"do":"set_pose","x":-1,"y":0.5,"yaw_deg":90}"#, "cairn"),
            "cairn command set-pose -1 0.5 90"
        );
        for (json, line) in [
            (r#"{"do":"store_map","name":""}"#, "cairn map --prefix left save"),
            (r#"{"do":"store_map","name":"a b"}"#, "cairn map --prefix left save 'a b'"),
            (r#"{"do":"load_map","name":"attic"}"#, "cairn map --prefix left load attic"),
            (r#"{"do":"new_map","name":"attic"}"#, "cairn map --prefix left new attic"),
            (r#"{"do":"localise_only","on":true}"#, "cairn map --prefix left localise on"),
            (r#"{"do":"list_maps"}"#, "cairn map --prefix left list"),
            (r#"{"do":"camera_controls"}"#, "cairn command --prefix left camera"),
            (
                r#"{"do":"set_camera","control":"exposure","value":8.5}"#,
                "cairn command --prefix left camera exposure 8.5",
            ),
            (r#"{"do":"set_camera","control":"gain","value":null}"#, "cairn command --prefix left camera gain auto"),
        ] {
            assert_eq!(terminal(json, "left"), line);
        }
    }

    #[test]
    fn what_is_no_button_is_refused() {
        for text in [r#"{"do":"shutdown"}"#, r#"{"do":"reset","now":1}"#, r#"{"do":"save_map"}"#, "[]", "1"] {
            assert!(serde_json::from_str::<Action>(text).is_err(), "{text}");
        }
        assert!(outcome(&CommandReply::new(reply_code::BUSY, "later")).is_err());
    }
}
