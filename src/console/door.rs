//! Connections of strangers, who have not said `hello` with the token: so many at a time, and the oldest of the address that has most gives way.
//!
//! Whoever reaches the console can open connections and say nothing on them. Were one more refused, they would keep the owner out; so an address has
//! more than its share only while nobody else comes. A request is answered in milliseconds: those who want something are the newest ones, and are
//! served however many others wait, from their own address as well (behind a tunnel or a proxy all have one). Many who come at once and want
//! something are not ended within a second, but wait for each other.

use std::net::{IpAddr, Shutdown, SocketAddr, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use super::hub::lock;

/// Strangers at a time, of all addresses.
pub const STRANGERS: usize = 96;
/// Who has come within this does not give way.
const GRACE: Duration = Duration::from_secs(1);
/// For the log.
const CROWDED: &str = "too many connections";

/// See module.
#[derive(Debug, Default)]
pub struct Door(Mutex<Crowd>);

#[derive(Debug, Default)]
struct Crowd {
    /// In the order in which they came.
    strangers: Vec<Stranger>,
    came: u64,
}

#[derive(Debug)]
struct Stranger {
    number: u64,
    peer: IpAddr,
    since: Instant,
    /// By which it is ended.
    stream: TcpStream,
}

/// A stranger's place, until it is let in or dropped.
#[derive(Debug)]
pub struct Stay {
    door: Arc<Door>,
    number: u64,
}

impl Door {
    /// Whether one more finds a place, or one that gives way.
    pub fn is_open(&self, now: Instant) -> bool {
        let crowd = lock(&self.0);
        let gives_way = |i: usize| now.saturating_duration_since(crowd.strangers[i].since) >= GRACE;
        crowd.strangers.len() < STRANGERS || crowd.first_to_go().is_some_and(gives_way)
    }

    /// A stranger comes. Where there are too many another one is ended, and `refuse` says of whom that was.
    pub fn enter(
        self: &Arc<Self>,
        peer: IpAddr,
        stream: TcpStream,
        now: Instant,
        refuse: &dyn Fn(Option<SocketAddr>, &'static str),
    ) -> Stay {
        let mut crowd = lock(&self.0);
        if crowd.strangers.len() >= STRANGERS
            && let Some(first) = crowd.first_to_go()
        {
            let gone = crowd.strangers.remove(first).stream;
            refuse(gone.peer_addr().ok(), CROWDED);
            // Its thread wakes, and ends; one that pauses after a wrong token pauses on. It may have gone by itself.
            let _ = gone.shutdown(Shutdown::Both);
        }
        crowd.came += 1;
        let number = crowd.came;
        // An IPv4 address is one whether the console listens on IPv6, too, or not.
        crowd.strangers.push(Stranger { number, peer: peer.to_canonical(), since: now, stream });
        Stay { door: self.clone(), number }
    }
}

impl Crowd {
    /// The oldest one of the address that has most.
    fn first_to_go(&self) -> Option<usize> {
        let count = |peer: IpAddr| self.strangers.iter().filter(|s| s.peer == peer).count();
        // Of equals the last one counts here, so they come in reverse.
        self.strangers.iter().enumerate().rev().max_by_key(|(_, s)| count(s.peer)).map(|(i, _)| i)
    }
}

impl Stay {
    /// It has said who it is, and counts as a page from now on.
    pub fn let_in(&self) {
        lock(&self.door.0).strangers.retain(|s| s.number != self.number);
    }
}

impl Drop for Stay {
    fn drop(&mut self) {
        self.let_in();
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;
    use std::net::TcpListener;

    use super::*;

    /// Somebody at the door, of an address that the test says.
    struct Visitor {
        stream: TcpStream,
        stay: Stay,
        /// The connection's own end: the door has another handle of it.
        _served: TcpStream,
    }

    impl Visitor {
        fn is_ended(&mut self) -> bool {
            self.stream.set_read_timeout(Some(Duration::from_millis(2))).expect("time-out");
            matches!(self.stream.read(&mut [0]), Ok(0))
        }
    }

    struct Street {
        listener: TcpListener,
        door: Arc<Door>,
        now: Instant,
    }

    impl Street {
        fn new() -> Self {
            let listener = TcpListener::bind("127.0.0.1:0").expect("listener");
            Self { listener, door: Arc::default(), now: Instant::now() }
        }

        fn come(&self, peer: &str) -> Visitor {
            let stream = TcpStream::connect(self.listener.local_addr().expect("address")).expect("connected");
            let (ours, _) = self.listener.accept().expect("accepted");
            let end = ours.try_clone().expect("a second handle");
            let stay =
                self.door.enter(peer.parse().expect("address"), end, self.now, &|_, why| assert_eq!(why, CROWDED));
            Visitor { stream, stay, _served: ours }
        }

        fn crowd(&self, peer: &str, count: usize) -> Vec<Visitor> {
            (0..count).map(|_| self.come(peer)).collect()
        }
    }

    fn ended(visitors: &mut [Visitor]) -> Vec<usize> {
        visitors.iter_mut().enumerate().filter_map(|(i, v)| v.is_ended().then_some(i)).collect()
    }

    #[test]
    fn the_oldest_of_the_address_that_has_most_gives_way() {
        let street = Street::new();
        let (mut few, mut many) = (street.crowd("10.0.0.1", 2), street.crowd("10.0.0.2", 40));
        let mut rest: Vec<Visitor> = (0..STRANGERS - 43).map(|i| street.come(&format!("10.0.1.{i}"))).collect();
        // The same address as an IPv6 socket has it.
        many.push(street.come("::ffff:10.0.0.2"));
        assert!([&mut few, &mut many, &mut rest].into_iter().all(|crowd| ended(crowd).is_empty()));
        let mut owner = street.crowd("10.0.0.9", 3);
        assert_eq!((ended(&mut many), ended(&mut owner)), (vec![0, 1, 2], vec![]));
        assert_eq!((ended(&mut few), ended(&mut rest)), (vec![], vec![]));
    }

    #[test]
    fn of_one_address_alone_the_oldest_gives_way() {
        let street = Street::new();
        let (mut many, mut owner) = (street.crowd("127.0.0.1", STRANGERS), street.crowd("127.0.0.1", 2));
        assert_eq!((ended(&mut many), ended(&mut owner)), (vec![0, 1], vec![]));
    }

    #[test]
    fn many_who_come_at_once_wait_for_each_other() {
        let mut street = Street::new();
        let mut many = street.crowd("10.0.0.1", STRANGERS);
        assert!(!street.door.is_open(street.now + GRACE / 2), "nobody is ended so soon");
        assert!(street.door.is_open(street.now + GRACE));
        many.pop();
        assert!(street.door.is_open(street.now), "one has gone");
        street.now += GRACE;
        many.push(street.come("10.0.0.1"));
        assert!(street.door.is_open(street.now) && ended(&mut many).is_empty());
    }

    #[test]
    fn who_is_let_in_or_has_gone_does_not_count() {
        let street = Street::new();
        let mut pages = street.crowd("10.0.0.1", STRANGERS);
        pages.iter().for_each(|page| page.stay.let_in());
        let mut more = street.crowd("10.0.0.1", STRANGERS);
        more.truncate(1);
        more.extend(street.crowd("10.0.0.1", STRANGERS - 1));
        assert_eq!((ended(&mut pages), ended(&mut more)), (vec![], vec![]));
    }
}
