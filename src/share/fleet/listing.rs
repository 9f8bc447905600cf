//! What is told of a fleet at one time.

use serde::Serialize;

use super::report::Level;

/// Whether a robot is there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Presence {
    Here,
    /// Its bridge has come, and nothing was heard of the daemon so far.
    New,
    /// Its bridge is there, and tells nothing.
    Silent,
    /// Its bridge has left, was killed, or is out of reach.
    Gone,
    /// It cannot be known: the network is away.
    Unseen,
}

/// Where a robot is on the floor of its map: m, rad, seen from above.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Place {
    pub x_m: f64,
    pub y_m: f64,
    pub yaw_rad: f64,
}

/// One robot. State, scale, health and faults are those of now: `None` and none of one that is not here.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// `/`: the root.
    pub name: String,
    /// Its Zenoh session's id, which tells robots with one name apart.
    pub session: String,
    pub presence: Presence,
    /// Another robot that is there has the same name.
    pub is_name_shared: bool,
    pub state: Option<String>,
    pub scale: Option<String>,
    pub health: Option<Level>,
    pub faults: Vec<String>,
    /// The frame of its map, where that is one that several robots may have: the dock's, or that of the map of one of those that share keyframes.
    pub map_frame: Option<String>,
    /// Where it is in that frame; `None` as well where poses are not listened to.
    pub place: Option<Place>,
    /// Where it was there, oldest first, m.
    #[serde(skip)]
    pub trail: Vec<[f64; 2]>,
    /// Its last state, if it is not here.
    pub last_state: Option<String>,
    /// Since its last diagnostics, s; `None`: there were none.
    pub heard_s_ago: Option<f64>,
    /// Its diagnostics are not understood.
    pub problem: Option<String>,
}

/// See module. Rows by name and session.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Listing {
    pub domain: u32,
    /// A Zenoh router is there.
    pub has_router: bool,
    /// Anybody is there.
    pub is_connected: bool,
    pub robots: Vec<Row>,
    /// What is wrong with the whole, one sentence each.
    pub notices: Vec<String>,
}

impl Listing {
    /// Without what changes by time alone.
    pub fn timeless(&self) -> Self {
        let mut same = self.clone();
        for row in &mut same.robots {
            (row.heard_s_ago, row.place) = (None, None);
            row.trail.clear();
        }
        same
    }
}
