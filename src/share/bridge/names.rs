//! rmw_zenoh's names: the key of a topic or service, and the liveliness token of whoever has it. Pure.
//!
//! ```text
//! key     DOMAIN/TOPIC/PACKAGE::msg::dds_::TYPE_/RIHS01_HASH
//! token   @ros2_lv/DOMAIN/SESSION/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NAME[/TOPIC/TYPE/HASH/QOS]
//! ```
//!
//! In a token each slash of a name is `%`. Source: rmw_zenoh, docs/design.md. Hashes are those of REP-2016, the same in every ROS 2 since Iron:
//! messages' as PyPI's `rosbags` computes them (`tests/peers/bridge.py` compares), a service's by the same rule from its request, response and event.

use super::BridgeError;

/// A type of ROS 2's interfaces.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Type {
    /// `nav_msgs/msg/Odometry`.
    pub name: &'static str,
    /// Hexadecimal, of its definition.
    pub hash: &'static str,
}

pub const INITIAL_POSE: Type = Type {
    name: "geometry_msgs/msg/PoseWithCovarianceStamped",
    hash: "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
};
pub const TRIGGER: Type =
    Type { name: "std_srvs/srv/Trigger", hash: "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f" };

impl Type {
    fn dds(self) -> String {
        let (package, type_name) = self.name.rsplit_once('/').unwrap_or(("", self.name));
        format!("{}::dds_::{type_name}_", package.replace('/', "::"))
    }

    fn hash(self) -> String {
        format!("RIHS01_{}", self.hash)
    }
}

/// Where messages of a topic, or requests to a service, go.
pub fn key(domain: u32, topic: &str, of: Type) -> String {
    format!("{domain}/{}/{}/{}", topic.trim_start_matches('/'), of.dds(), of.hash())
}

fn mangled(name: &str) -> String {
    name.replace('/', "%")
}

/// Liveliness tokens of whoever subscribes to a topic, whatever the type that he takes it for.
pub fn subscribers(domain: u32, topic: &str) -> String {
    format!("@ros2_lv/{domain}/*/*/*/MS/*/*/*/{}/**", mangled(topic))
}

/// Bytes of a token that is looked at: ROS 2's names have 255 at most, and there are three of them in it.
const LONGEST_TOKEN: usize = 1024;
/// Of a Zenoh session's id, in hexadecimal.
const LONGEST_SESSION: usize = 32;

/// Liveliness tokens of all bridges that publish a topic.
pub fn bridges(domain: u32, topic: &str) -> String {
    format!("@ros2_lv/{domain}/*/*/*/{}/*/*/{NODE}/{}/**", Kind::Publisher.word(), mangled(topic))
}

/// The same of a topic that each has in its own namespace.
pub fn bridges_own(domain: u32, word: &str) -> String {
    format!("@ros2_lv/{domain}/*/*/*/{}/*/*/{NODE}/$*%{word}/**", Kind::Publisher.word())
}

/// Where these messages go, whatever the robot.
pub fn key_of_all(domain: u32, word: &str, of: Type) -> String {
    key(domain, &format!("/**/{word}"), of)
}

/// The session and the robot of such a token. `None`: it is none, or longer than any.
pub fn owner(token: &str) -> Option<(&str, Robot)> {
    if token.len() > LONGEST_TOKEN {
        return None;
    }
    let words: Vec<&str> = token.split('/').collect();
    let [_, _, session, _, _, _, _, namespace, NODE, ..] = words[..] else { return None };
    let robot = Robot::new(&namespace.replace('%', "/")).ok()?;
    is_session(session).then_some((session, robot))
}

/// Where a robot's stored maps are asked for; in any session without one. The first chunk is one that patterns leave out.
pub fn maps_key(domain: u32, session: Option<&str>, robot: &Robot) -> String {
    format!("@cairn/{domain}/{}/{}/maps", session.unwrap_or("*"), mangled(&robot.namespace()))
}

/// The session of such a key.
pub fn owner_of_maps(key: &str) -> Option<&str> {
    let session = key.split('/').nth(2)?;
    is_session(session).then_some(session)
}

fn is_session(text: &str) -> bool {
    (1..=LONGEST_SESSION).contains(&text.len()) && text.chars().all(|c| c.is_ascii_hexdigit())
}

/// Of what a token tells. Not here: clients, of which a bridge has none.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Publisher,
    Subscription,
    Service,
}

impl Kind {
    fn word(self) -> &'static str {
        match self {
            Self::Publisher => "MP",
            Self::Subscription => "MS",
            Self::Service => "SS",
        }
    }
}

/// Quality of service, as far as anything here differs in it: the history is always "keep last".
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Qos {
    pub is_reliable: bool,
    pub is_transient_local: bool,
    pub depth: usize,
}

impl Qos {
    pub const fn reliable(depth: usize) -> Self {
        Self { is_reliable: true, is_transient_local: false, depth }
    }

    /// "Sensor data".
    pub const fn best_effort(depth: usize) -> Self {
        Self { is_reliable: false, is_transient_local: false, depth }
    }

    /// Late joiners get the last ones.
    pub const fn transient_local(depth: usize) -> Self {
        Self { is_reliable: true, is_transient_local: true, depth }
    }

    /// Reliability, durability, history and depth, deadline, lifespan, liveliness; empty is rmw_zenoh's default (reliable, volatile, keep last, 42).
    fn text(self) -> String {
        let (best_effort, transient_local) = ("2", "1");
        let reliability = if self.is_reliable { "" } else { best_effort };
        let durability = if self.is_transient_local { transient_local } else { "" };
        let depth = if self.depth == 42 { String::new() } else { self.depth.to_string() };
        format!("{reliability}:{durability}:,{depth}:,:,:,,")
    }
}

/// A robot's namespace.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Robot {
    /// `robot1`; empty: the root.
    name: String,
}

impl Robot {
    /// `robot1`, `fleet/robot1`, or `/` for topics without a namespace.
    pub fn new(name: &str) -> Result<Self, BridgeError> {
        let bare = name.trim_matches('/');
        let is_word = |word: &str| {
            let allowed = |c: char| c.is_ascii_alphanumeric() || c == '_';
            !word.is_empty() && word.chars().all(allowed) && !word.starts_with(|c: char| c.is_ascii_digit())
        };
        let is_root = bare.is_empty() && !name.is_empty();
        if is_root || bare.split('/').all(is_word) {
            return Ok(Self { name: bare.into() });
        }
        Err(BridgeError::Name { name: name.into() })
    }

    /// Of a daemon's prefix; what ROS 2 does not allow becomes _.
    pub fn of_prefix(prefix: &str) -> Result<Self, BridgeError> {
        let words = crate::share::frames::ros_name(prefix);
        let words: Vec<String> = words
            .split('/')
            .filter(|word| !word.is_empty())
            .map(|word| if word.starts_with(|c: char| c.is_ascii_digit()) { format!("_{word}") } else { word.into() })
            .collect();
        Self::new(&words.join("/"))
    }

    pub fn name(&self) -> &str {
        &self.name
    }

    /// `/robot1`, or `/`.
    fn namespace(&self) -> String {
        format!("/{}", self.name)
    }

    /// A topic or service in its namespace.
    pub fn topic(&self, name: &str) -> String {
        if self.name.is_empty() { format!("/{name}") } else { format!("/{}/{name}", self.name) }
    }
}

/// The one node that a bridge is.
#[derive(Debug, Clone)]
pub struct Identity {
    pub domain: u32,
    /// Of the Zenoh session.
    pub session: String,
    pub robot: Robot,
}

/// The node's name.
const NODE: &str = "cairn_bridge";
/// Its number in the session, which it has alone.
const NODE_ID: u32 = 0;

impl Identity {
    fn head(&self, entity: u32, kind: &str) -> String {
        let (domain, session, namespace) = (self.domain, &self.session, mangled(&self.robot.namespace()));
        // There is no enclave of SROS.
        format!("@ros2_lv/{domain}/{session}/{NODE_ID}/{entity}/{kind}/%/{namespace}/{NODE}")
    }

    pub fn node_token(&self) -> String {
        self.head(NODE_ID, "NN")
    }

    /// `entity`: another number for each.
    pub fn token(&self, entity: u32, kind: Kind, topic: &str, of: Type, qos: Qos) -> String {
        let head = self.head(entity, kind.word());
        format!("{head}/{}/{}/{}/{}", mangled(topic), of.dds(), of.hash(), qos.text())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ADD_TWO_INTS: Type = Type {
        name: "example_interfaces/srv/AddTwoInts",
        hash: "e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
    };
    const STRING: Type =
        Type { name: "std_msgs/msg/String", hash: "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18" };

    #[test]
    fn keys_are_those_of_the_design() {
        let chatter = "0/robot1/chatter/std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";
        assert_eq!(key(0, "/robot1/chatter", STRING), chatter);
        let service = "2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a";
        assert_eq!(key(2, "/add_two_ints", ADD_TWO_INTS), service);
    }

    #[test]
    fn tokens_are_those_of_the_design() {
        let node = Identity {
            domain: 2,
            session: "8b20917502ee955ac4476e0266340d5c".into(),
            robot: Robot::new("/").expect("root"),
        };
        let head = |id, kind| format!("@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/{id}/{kind}/%/%/cairn_bridge");
        assert_eq!(node.node_token(), head(0, "NN"));
        let publisher = node.token(10, Kind::Publisher, "/chatter", STRING, Qos::reliable(7));
        let tail = "%chatter/std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,7:,:,:,,";
        assert_eq!(publisher, format!("{}/{tail}", head(10, "MP")));
        let service = node.token(3, Kind::Service, "/add_two_ints", ADD_TWO_INTS, Qos::reliable(10));
        let tail = "%add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a/::,10:,:,:,,";
        assert_eq!(service, format!("{}/{tail}", head(3, "SS")));
        let named = Identity { robot: Robot::new("fleet/robot1").expect("name"), ..node };
        assert!(named.node_token().ends_with("/%/%fleet%robot1/cairn_bridge"));
    }

    #[test]
    fn what_differs_from_the_default_is_in_the_quality_of_service() {
        let texts = [Qos::reliable(42), Qos::best_effort(5), Qos::transient_local(1)].map(Qos::text);
        assert_eq!(texts, ["::,:,:,:,,", "2::,5:,:,:,,", ":1:,1:,:,:,,"]);
    }

    #[test]
    fn subscribers_of_a_topic_are_found_by_their_tokens() {
        let robot = Robot::new("robot1").expect("name");
        let node = Identity { domain: 7, session: "ab".into(), robot };
        let pattern = zenoh::key_expr::KeyExpr::new(subscribers(7, "/robot1/scan")).expect("key expression");
        let matches = |kind, topic: &str| {
            let token = node.token(4, kind, topic, STRING, Qos::best_effort(5));
            pattern.includes(&zenoh::key_expr::KeyExpr::new(token).expect("key expression"))
        };
        assert!(matches(Kind::Subscription, "/robot1/scan"));
        assert!(!matches(Kind::Publisher, "/robot1/scan") && !matches(Kind::Subscription, "/robot2/scan"));
    }

    #[test]
    fn bridges_are_found_by_their_tokens_and_a_token_tells_whose_it_is() {
        let node = |name| Identity { domain: 7, session: "ab01".into(), robot: Robot::new(name).expect("name") };
        let pattern = zenoh::key_expr::KeyExpr::new(bridges(7, "/diagnostics")).expect("key expression");
        for name in ["robot1", "fleet/robot1", "/"] {
            let token = node(name).token(4, Kind::Publisher, "/diagnostics", STRING, Qos::reliable(10));
            assert!(pattern.includes(&zenoh::key_expr::KeyExpr::new(token.clone()).expect("key expression")));
            assert_eq!(owner(&token), Some(("ab01", Robot::new(name).expect("name"))));
        }
        let own = zenoh::key_expr::KeyExpr::new(bridges_own(7, "pose")).expect("key expression");
        let all = zenoh::key_expr::KeyExpr::new(key_of_all(7, "pose", STRING)).expect("key expression");
        for (name, topic, is_met) in [
            ("robot1", "/robot1/pose", true),
            ("/", "/pose", true),
            ("a/b", "/a/b/pose", true),
            ("r", "/r/initialpose", false),
        ] {
            let token = node(name).token(4, Kind::Publisher, topic, STRING, Qos::reliable(10));
            assert_eq!(own.includes(&zenoh::key_expr::KeyExpr::new(token).expect("key expression")), is_met, "{topic}");
            let key = zenoh::key_expr::KeyExpr::new(key(7, topic, STRING)).expect("key expression");
            assert_eq!(all.includes(&key), is_met, "{topic}");
        }
        let token = node("robot1").token(4, Kind::Publisher, "/odom", STRING, Qos::reliable(10));
        assert!(!pattern.includes(&zenoh::key_expr::KeyExpr::new(token).expect("key expression")));
        let long = format!("%{}", "r".repeat(LONGEST_TOKEN));
        for (session, namespace, name) in [
            ("", "%r", NODE),
            ("xyz", "%r", NODE),
            ("\u{1b}[2J", "%r", NODE),
            ("ab", "%1", NODE),
            ("ab", "%r\u{1b}[2J", NODE),
            ("ab", "", NODE),
            ("ab", "%r", "talker"),
            ("ab", long.as_str(), NODE),
        ] {
            assert_eq!(owner(&format!("@ros2_lv/7/{session}/0/4/MP/%/{namespace}/{name}/%d/T/H/Q")), None);
        }
        assert_eq!((owner(""), owner("@ros2_lv/7/ab")), (None, None));
    }

    #[test]
    fn maps_are_asked_of_one_robot_and_of_no_pattern() {
        let robot = Robot::new("fleet/r1").expect("name");
        let own = maps_key(7, Some("ab01"), &robot);
        assert_eq!((own.as_str(), owner_of_maps(&own)), ("@cairn/7/ab01/%fleet%r1/maps", Some("ab01")));
        let meets = |pattern: &str| {
            let pattern = zenoh::key_expr::KeyExpr::new(pattern.to_owned()).expect("key expression");
            pattern.includes(&zenoh::key_expr::KeyExpr::new(own.clone()).expect("key expression"))
        };
        assert!(meets(&maps_key(7, None, &robot)) && !meets("**") && !meets("*/7/**"));
        assert_eq!((owner_of_maps("@cairn/7/*/%r/maps"), owner_of_maps("@cairn/7")), (None, None));
    }

    #[test]
    fn a_robots_name_is_one_that_ros_takes() {
        let topic = |name: &str| Robot::new(name).map(|robot| robot.topic("odom")).ok();
        assert_eq!(topic("robot1").as_deref(), Some("/robot1/odom"));
        assert_eq!(topic("/fleet/robot1").as_deref(), Some("/fleet/robot1/odom"));
        assert_eq!(topic("/").as_deref(), Some("/odom"));
        for wrong in ["", "robot 1", "1robot", "a//b", "robot-1", "r*"] {
            assert_eq!(topic(wrong), None, "{wrong}");
        }
        let of = |prefix: &str| Robot::of_prefix(prefix).map(|robot| robot.name).ok();
        assert_eq!(of("front-left/2").as_deref(), Some("front_left/_2"));
    }
}
