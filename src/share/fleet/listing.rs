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
        same.robots.iter_mut().for_each(|row| row.heard_s_ago = None);
        same
    }
}
