//! The robots of a network, from what happens there. No Zenoh, no clock: whoever tells it something says when.
//!
//! At most [`MOST_ROBOTS`] of them. One that is gone stays in it until another of its name comes, or until its place is needed; of the rest, those that
//! find no place are counted.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use super::anchors::common_frames;
use super::listing::{Listing, Presence, Row};
use super::path::Path;
use super::report::Report;
use crate::messages::Transform;
use crate::share::bridge::attachment::{GID_BYTES, gid};
use crate::share::bridge::names::{Robot, owner};
use crate::share::bridge::session::Link;

/// Robots that are told apart, some 200 bytes each: hundreds, and some over.
pub const MOST_ROBOTS: usize = 1024;
/// Diagnostics come once a second unless they name another period; Zenoh itself, too, takes a link for dead that was silent for so long.
pub const SILENT_AFTER: Duration = Duration::from_secs(10);
/// Of the periods that a robot names, where they are long: one message may be lost and the next one late.
const SILENT_PERIODS: u32 = 3;
/// Robots of one name, or names, that a sentence lists.
const MOST_LISTED: usize = 4;

struct Entry {
    name: String,
    session: String,
    came: Instant,
    gone: Option<Instant>,
    heard: Option<Instant>,
    /// The last, or why it is none.
    told: Option<Result<Report, String>>,
    path: Path,
    /// The anchor in whose frame the path is; `None`: the map's own, which has a dock.
    path_in: Option<u64>,
}

impl Entry {
    fn report(&self) -> Option<&Report> {
        self.told.as_ref().and_then(|told| told.as_ref().ok())
    }

    /// Frame of a dock.
    fn map_frame(&self) -> Option<&str> {
        self.report().and_then(|report| report.map_frame.as_deref())
    }

    /// Where the path's frame is in the robot's map; `None`: no frame of it may be another robot's as well.
    fn origin(&self) -> Option<Transform> {
        let report = self.report()?;
        match self.path_in {
            Some(name) => report.anchors.iter().find(|anchor| anchor.0 == name).map(|anchor| anchor.1),
            None => report.map_frame.as_ref().map(|_| Transform::IDENTITY),
        }
    }

    /// How long it may say nothing.
    fn patience(&self) -> Duration {
        let period = self.report().map_or(Duration::ZERO, |report| report.period);
        SILENT_AFTER.max(SILENT_PERIODS * period)
    }
}

/// Whose token may come before the robot's.
struct PosePublisher {
    name: String,
    session: String,
    /// Once it was found.
    robot: Option<[u8; GID_BYTES]>,
}

fn name_of(robot: &Robot) -> &str {
    if robot.name().is_empty() { "/" } else { robot.name() }
}

/// See module.
pub struct Table {
    domain: u32,
    /// By their publishers' ids.
    robots: BTreeMap<[u8; GID_BYTES], Entry>,
    /// By their own ids; [`MOST_ROBOTS`] of them.
    poses: BTreeMap<[u8; GID_BYTES], PosePublisher>,
    link: Link,
    /// Robots without a place.
    left_out: u64,
    /// Tokens that are no robot's.
    refused: u64,
}

impl Table {
    pub fn new(domain: u32) -> Self {
        Self { domain, robots: BTreeMap::new(), poses: BTreeMap::new(), link: Link::Nobody, left_out: 0, refused: 0 }
    }

    pub fn token_up(&mut self, token: &str, now: Instant) {
        let Some((session, robot)) = owner(token) else {
            self.refused = self.refused.saturating_add(1);
            return;
        };
        let id = gid(token);
        let name = name_of(&robot);
        // A robot that was started anew takes its own row.
        self.robots.retain(|other, entry| *other == id || entry.gone.is_none() || entry.name != name);
        if let Some(entry) = self.robots.get_mut(&id) {
            if entry.gone.take().is_some() {
                entry.came = now;
            }
            return;
        }
        if self.robots.len() >= MOST_ROBOTS {
            let gone = self.robots.iter().filter_map(|(id, entry)| entry.gone.map(|at| (at, *id)));
            let Some((_, oldest)) = gone.min() else {
                self.left_out = self.left_out.saturating_add(1);
                return;
            };
            self.robots.remove(&oldest);
        }
        let (name, session) = (name.to_owned(), session.to_owned());
        let (gone, heard, told, path, path_in) = (None, None, None, Path::default(), None);
        self.robots.insert(id, Entry { name, session, came: now, gone, heard, told, path, path_in });
    }

    pub fn token_down(&mut self, token: &str, now: Instant) {
        match self.robots.get_mut(&gid(token)) {
            Some(entry) => entry.gone = entry.gone.or(Some(now)),
            None if owner(token).is_some() => self.left_out = self.left_out.saturating_sub(1),
            None => {}
        }
    }

    /// Of the publisher with this id, who may be anybody.
    pub fn diagnostics(&mut self, id: &[u8; GID_BYTES], message: &[u8], now: Instant) {
        if let Some(entry) = self.robots.get_mut(id) {
            entry.heard = Some(now);
            let before = entry.map_frame().map(str::to_owned);
            entry.told = Some(Report::of(message).map_err(|e| e.to_string()));
            if entry.map_frame() != before.as_deref() || entry.origin().is_none() {
                // What was told before is of another frame.
                entry.path = Path::default();
                let first = entry.report().filter(|report| report.map_frame.is_none());
                entry.path_in = first.and_then(|report| report.anchors.first()).map(|anchor| anchor.0);
            }
        }
    }

    pub fn pose_token_up(&mut self, token: &str) {
        if let Some((session, robot)) = owner(token).filter(|_| self.poses.len() < MOST_ROBOTS) {
            let (name, session) = (name_of(&robot).to_owned(), session.to_owned());
            self.poses.insert(gid(token), PosePublisher { name, session, robot: None });
        }
    }

    pub fn pose_token_down(&mut self, token: &str) {
        self.poses.remove(&gid(token));
    }

    /// Of the publisher with this id, who may be anybody.
    pub fn pose(&mut self, id: &[u8; GID_BYTES], message: &[u8], now: Instant) {
        let Some(publisher) = self.poses.get_mut(id) else { return };
        if publisher.robot.is_none() {
            let is_its = |entry: &Entry| entry.session == publisher.session && entry.name == publisher.name;
            publisher.robot = self.robots.iter().find(|(_, entry)| is_its(entry)).map(|(id, _)| *id);
        }
        let entry = publisher.robot.and_then(|robot| self.robots.get_mut(&robot));
        let Some(entry) = entry else { return };
        if let Some(origin) = entry.origin() {
            entry.path.add(message, &origin, now);
        }
    }

    pub fn network(&mut self, link: Link) {
        self.link = link;
    }

    pub fn listing(&self, now: Instant) -> Listing {
        let shared = self.shared_names();
        let mut entries: Vec<&Entry> = self.robots.values().collect();
        entries.sort_by(|a, b| (&a.name, &a.session).cmp(&(&b.name, &b.session)));
        let anchors = |entry: &&Entry| match entry.report() {
            Some(report) if self.presence(entry, now) == Presence::Here => report.anchors.clone(),
            _ => Vec::new(),
        };
        let placed = common_frames(&entries.iter().map(anchors).collect::<Vec<_>>());
        let robots = entries.iter().zip(placed).map(|(entry, place)| self.row(entry, place, &shared, now)).collect();
        Listing {
            domain: self.domain,
            has_router: self.link == Link::Router,
            is_connected: self.link != Link::Nobody,
            notices: self.notices(&shared),
            robots,
        }
    }

    /// Names of several robots that are there, with their sessions.
    fn shared_names(&self) -> BTreeMap<&str, BTreeSet<&str>> {
        let mut sessions: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
        for entry in self.robots.values().filter(|entry| entry.gone.is_none()) {
            sessions.entry(&entry.name).or_default().insert(&entry.session);
        }
        sessions.retain(|_, sessions| sessions.len() > 1);
        sessions
    }

    fn presence(&self, entry: &Entry, now: Instant) -> Presence {
        let quiet = now.saturating_duration_since(entry.heard.map_or(entry.came, |heard| heard.max(entry.came)));
        match (self.link, entry.gone) {
            (Link::Nobody, _) | (Link::Peers, Some(_)) => Presence::Unseen,
            (Link::Router, Some(_)) => Presence::Gone,
            (_, None) if quiet > entry.patience() => Presence::Silent,
            (_, None) if entry.heard.is_none_or(|heard| heard < entry.came) => Presence::New,
            (_, None) => Presence::Here,
        }
    }

    /// `common`: the frame that its map has in common with others, by what they see in both, and where its own is in it.
    fn row(
        &self,
        entry: &Entry,
        common: Option<(u64, Transform)>,
        shared: &BTreeMap<&str, BTreeSet<&str>>,
        now: Instant,
    ) -> Row {
        let presence = self.presence(entry, now);
        let is_here = presence == Presence::Here;
        let told = entry.report();
        let dock = entry.map_frame().map(|dock| (dock.to_owned(), Transform::IDENTITY));
        let frame = dock.or_else(|| common.map(|(name, place)| (format!("map_{name:x}"), place))).filter(|_| is_here);
        let drawn = frame.as_ref().zip(entry.origin()).map(|((_, place), origin)| *place * origin);
        let current = told.filter(|_| is_here);
        let problem = entry.told.as_ref().and_then(|told| told.as_ref().err()).filter(|_| is_here);
        Row {
            name: entry.name.clone(),
            session: entry.session.clone(),
            presence,
            is_name_shared: entry.gone.is_none() && shared.contains_key(entry.name.as_str()),
            state: current.map(|report| report.state.clone()),
            scale: current.and_then(|report| report.scale.clone()),
            health: current.map(|report| report.level),
            faults: current.map(|report| report.faults.clone()).unwrap_or_default(),
            map_frame: frame.map(|(name, _)| name),
            place: drawn.and_then(|drawn| entry.path.place(now, &drawn)),
            trail: drawn.map(|drawn| entry.path.points(&drawn)).unwrap_or_default(),
            last_state: told.filter(|_| !is_here).map(|report| report.state.clone()),
            heard_s_ago: entry.heard.map(|heard| now.saturating_duration_since(heard).as_secs_f64()),
            problem: problem.map(|reason| format!("its diagnostics are not understood: {reason}")),
        }
    }

    fn notices(&self, shared: &BTreeMap<&str, BTreeSet<&str>>) -> Vec<String> {
        let mut notices = Vec::new();
        match self.link {
            Link::Router => {}
            Link::Peers => notices.push("no Zenoh router: only robots that are connected directly are seen".into()),
            Link::Nobody => notices.push("no Zenoh router: no robot can be seen".into()),
        }
        for (name, sessions) in shared.iter().take(MOST_LISTED) {
            let listed: Vec<&str> = sessions.iter().copied().take(MOST_LISTED).collect();
            let count = sessions.len();
            notices.push(format!("{count} robots have the name {name}, in the sessions {}", listed.join(", ")));
        }
        if let more @ 1.. = shared.len().saturating_sub(MOST_LISTED) {
            notices.push(format!("{more} more names are those of several robots"));
        }
        if self.left_out > 0 {
            notices.push(format!("{} robots more than the {MOST_ROBOTS} that are listed", self.left_out));
        }
        if self.refused > 0 {
            notices.push(format!("{} liveliness tokens that are no robot's", self.refused));
        }
        notices
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::{Health, error};
    use crate::share::bridge::names::{Identity, Kind};
    use crate::share::bridge::topic::Topic;
    use crate::share::fleet::report::tests::message;

    fn token(name: &str, session: &str) -> String {
        let robot = Robot::new(name).expect("name");
        let topic = Topic::Diagnostics;
        let identity = Identity { domain: 0, session: session.into(), robot };
        identity.token(7, Kind::Publisher, "/diagnostics", topic.of(), topic.qos())
    }

    fn metric() -> Vec<u8> {
        message(&Health::default(), &[("scale", "METRIC")])
    }

    /// With a router.
    fn table() -> (Table, Instant) {
        let mut table = Table::new(0);
        table.network(Link::Router);
        (table, Instant::now())
    }

    fn seconds(count: u64) -> Duration {
        Duration::from_secs(count)
    }

    fn presences(table: &Table, now: Instant) -> Vec<Presence> {
        table.listing(now).robots.iter().map(|row| row.presence).collect()
    }

    #[test]
    fn a_robot_is_new_here_silent_and_gone() {
        let ((mut table, start), token) = (table(), token("fleet/r1", "ab"));
        table.token_up(&token, start);
        assert_eq!(presences(&table, start + SILENT_AFTER), [Presence::New]);
        assert_eq!(presences(&table, start + seconds(11)), [Presence::Silent]);
        table.diagnostics(&gid(&token), &metric(), start + seconds(12));
        let here = table.listing(start + seconds(13));
        let row = &here.robots[0];
        assert_eq!((row.name.as_str(), row.session.as_str(), row.presence), ("fleet/r1", "ab", Presence::Here));
        assert_eq!((row.state.as_deref(), row.scale.as_deref()), (Some("INITIALIZING"), Some("METRIC")));
        assert_eq!((row.heard_s_ago, here.notices.len()), (Some(1.0), 0));
        assert_eq!(presences(&table, start + seconds(23)), [Presence::Silent]);
        table.token_down(&token, start + seconds(13));
        let row = &table.listing(start + seconds(14)).robots[0];
        // What it was is not what it is.
        assert_eq!(
            (row.presence, row.state.clone(), row.scale.clone(), row.health),
            (Presence::Gone, None, None, None)
        );
        assert_eq!(row.last_state.as_deref(), Some("INITIALIZING"));
        table.token_up(&token, start + seconds(20));
        assert_eq!(presences(&table, start + seconds(21)), [Presence::New]);
    }

    #[test]
    fn a_robot_that_says_how_rarely_it_speaks_is_not_silent_meanwhile() {
        let ((mut table, start), token) = (table(), token("r", "aa"));
        table.token_up(&token, start);
        table.diagnostics(&gid(&token), &message(&Health::default(), &[("period_s", "20")]), start);
        assert_eq!(presences(&table, start + seconds(60)), [Presence::Here]);
        assert_eq!(presences(&table, start + seconds(61)), [Presence::Silent]);
        table.diagnostics(&gid(&token), &metric(), start + seconds(70));
        assert_eq!(presences(&table, start + seconds(81)), [Presence::Silent]);
    }

    #[test]
    fn a_robot_has_a_place_where_its_map_is_in_a_frame_that_others_have() {
        let ((mut table, now), token) = (table(), token("r", "aa"));
        let publisher = token.replace("%diagnostics", "%r%pose");
        let docked = |frame| message(&Health::default(), &[("map_frame", frame)]);
        let pose = |table: &mut Table, x| {
            table.pose(&gid(&publisher), &crate::share::fleet::path::tests::pose("map", x, 0.0, 0.0), now)
        };
        let place = |table: &Table| table.listing(now).robots[0].place.map(|place| place.x_m);
        table.pose_token_up(&publisher);
        pose(&mut table, 1.0);
        table.token_up(&token, now);
        pose(&mut table, 1.0);
        assert_eq!(place(&table), None);
        table.diagnostics(&gid(&token), &docked("dock_36h11_5"), now);
        pose(&mut table, 2.0);
        assert_eq!((place(&table), table.listing(now).robots[0].trail.len()), (Some(2.0), 1));
        // In another frame it is somewhere else.
        table.diagnostics(&gid(&token), &docked("dock_36h11_6"), now);
        assert_eq!(place(&table), None);
        table.diagnostics(&gid(&token), &metric(), now);
        pose(&mut table, 3.0);
        assert_eq!((place(&table), table.listing(now).robots[0].map_frame.clone()), (None, None));
        // In a map whose keyframes others may have it is where it is, wherever that map is put.
        let anchored = |anchors| message(&Health::default(), &[("map_anchors", anchors)]);
        let lies = |table: &Table| {
            let row = table.listing(now).robots.remove(0);
            (row.map_frame, row.place.map(|place| (place.x_m, place.y_m)), row.trail.len())
        };
        table.diagnostics(&gid(&token), &anchored("a 1 0 0,b 2 0 0"), now);
        assert_eq!(lies(&table), (Some("map_a".into()), None, 0));
        pose(&mut table, 2.0);
        assert_eq!(lies(&table), (Some("map_a".into()), Some((2.0, 0.0)), 1));
        table.diagnostics(&gid(&token), &anchored("a 11 0 0,b 12 0 0"), now);
        assert_eq!(lies(&table).1, Some((12.0, 0.0)), "the map was put elsewhere, and it with it");
        table.diagnostics(&gid(&token), &anchored("b 12 0 0"), now);
        assert_eq!(lies(&table).1, None, "it is known by another keyframe");
        table.diagnostics(&gid(&token), &docked("dock_36h11_5"), now);
        table.pose_token_down(&publisher);
        pose(&mut table, 4.0);
        assert_eq!(place(&table), None);
    }

    #[test]
    fn two_robots_with_one_name_are_told_apart_and_said() {
        let ((mut table, now), tokens) = (table(), [token("r", "aa"), token("r", "bb"), token("s", "cc")]);
        tokens.iter().for_each(|token| table.token_up(token, now));
        let lost = Health { errors: error::LOST, ..Health::default() };
        table.diagnostics(&gid(&tokens[0]), &metric(), now);
        table.diagnostics(&gid(&tokens[1]), &message(&lost, &[]), now);
        let listing = table.listing(now);
        let faults: Vec<usize> = listing.robots.iter().map(|row| row.faults.len()).collect();
        assert_eq!(faults, [0, 1, 0]);
        assert_eq!(listing.robots.iter().map(|row| row.is_name_shared).collect::<Vec<_>>(), [true, true, false]);
        assert_eq!(listing.notices, ["2 robots have the name r, in the sessions aa, bb"]);
        table.token_down(&tokens[0], now);
        let listing = table.listing(now);
        assert!(listing.notices.is_empty() && listing.robots.iter().all(|row| !row.is_name_shared));
        assert_eq!(listing.robots.len(), 3);
        // One that is started anew has another session, and takes the row of what is gone.
        table.token_up(&token("r", "dd"), now);
        let sessions: Vec<String> = table.listing(now).robots.into_iter().map(|row| row.session).collect();
        assert_eq!(sessions, ["bb", "dd", "cc"]);
    }

    #[test]
    fn without_a_router_nobody_is_said_to_be_gone() {
        let ((mut table, now), token) = (table(), token("r", "aa"));
        table.token_up(&token, now);
        table.diagnostics(&gid(&token), &metric(), now);
        table.network(Link::Nobody);
        assert_eq!(presences(&table, now), [Presence::Unseen]);
        assert_eq!(table.listing(now).robots[0].state, None);
        table.token_down(&token, now);
        for link in [Link::Nobody, Link::Peers] {
            table.network(link);
            assert_eq!(presences(&table, now), [Presence::Unseen]);
            assert!(table.listing(now).notices[0].starts_with("no Zenoh router"));
        }
        table.network(Link::Router);
        assert_eq!(presences(&table, now), [Presence::Gone]);
    }

    #[test]
    fn more_robots_than_there_is_room_for_are_counted_and_those_gone_make_room() {
        let (mut table, now) = table();
        let tokens: Vec<String> = (0..=MOST_ROBOTS).map(|i| token(&format!("r{i}"), "aa")).collect();
        tokens.iter().for_each(|token| table.token_up(token, now));
        let listing = table.listing(now);
        assert_eq!((listing.robots.len(), listing.notices.len()), (MOST_ROBOTS, 1));
        assert!(listing.notices[0].starts_with("1 robots more"), "{:?}", listing.notices);
        table.token_down(&tokens[MOST_ROBOTS], now);
        assert!(table.listing(now).notices.is_empty());
        table.token_down(&tokens[5], now);
        table.token_up(&tokens[MOST_ROBOTS], now);
        let listing = table.listing(now);
        assert!(listing.robots.len() == MOST_ROBOTS && listing.robots.iter().all(|row| row.name != "r5"));
    }

    #[test]
    fn strangers_are_no_robots_and_what_is_not_understood_is_said() {
        let ((mut table, now), token) = (table(), token("r", "aa"));
        table.token_up("@ros2_lv/0/aa", now);
        table.diagnostics(&[9; GID_BYTES], &metric(), now);
        table.token_down("@ros2_lv/0/aa", now);
        assert_eq!(table.listing(now).robots.len(), 0);
        assert_eq!(table.listing(now).notices, ["1 liveliness tokens that are no robot's"]);
        table.token_up(&token, now);
        table.diagnostics(&gid(&token), &metric()[..20], now);
        let row = &table.listing(now).robots[0];
        assert_eq!((row.presence, row.state.clone()), (Presence::Here, None));
        assert!(row.problem.as_ref().is_some_and(|text| text.contains("not understood")), "{row:?}");
    }

    #[test]
    fn time_alone_is_no_news() {
        let ((mut table, now), token) = (table(), token("r", "aa"));
        table.token_up(&token, now);
        table.diagnostics(&gid(&token), &metric(), now);
        let at = |count| table.listing(now + seconds(count)).timeless();
        assert!(at(1) == at(2) && at(2) != at(12));
    }
}
