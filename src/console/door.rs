//! Connections of strangers, who have not said `hello` with the token: so many of one address, so many of all, and the oldest gives way.
//!
//! Whoever reaches the console can open connections and say nothing on them. Were one more refused, they would keep the owner out; so the oldest one
//! of the address that has most is ended instead. A request is answered in milliseconds: those who want something are the newest ones, and are served
//! however many others wait, from their own address as well (behind a tunnel or a proxy all have one).

use std::net::{IpAddr, Shutdown, SocketAddr, TcpStream};
use std::sync::{Arc, Mutex};

use super::hub::{MAX_PAGES, lock};

/// Strangers of one address: all the pages that there may be come at once when the console starts anew, and a browser has six requests under way.
const OF_ONE: usize = MAX_PAGES;
/// Strangers of all addresses.
pub const OF_ALL: usize = 96;
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
    /// A stranger comes. Where there are too many another one is ended, and `refuse` says of whom that was.
    pub fn enter(
        self: &Arc<Self>,
        peer: IpAddr,
        stream: TcpStream,
        refuse: &dyn Fn(Option<SocketAddr>, &'static str),
    ) -> Stay {
        // An IPv4 address is one whether the console listens on IPv6, too, or not.
        let peer = peer.to_canonical();
        let mut crowd = lock(&self.0);
        let of_one = crowd.count(peer) >= OF_ONE;
        if (of_one || crowd.strangers.len() >= OF_ALL)
            && let Some(oldest) = crowd.oldest(of_one.then_some(peer))
        {
            let gone = crowd.strangers.remove(oldest).stream;
            refuse(gone.peer_addr().ok(), CROWDED);
            // Its thread wakes, and ends; one that pauses after a wrong token pauses on. It may have gone by itself.
            let _ = gone.shutdown(Shutdown::Both);
        }
        crowd.came += 1;
        let number = crowd.came;
        crowd.strangers.push(Stranger { number, peer, stream });
        Stay { door: self.clone(), number }
    }
}

impl Crowd {
    fn count(&self, peer: IpAddr) -> usize {
        self.strangers.iter().filter(|s| s.peer == peer).count()
    }

    /// Who gives way: the oldest one of this address, or of the one that has most.
    fn oldest(&self, of: Option<IpAddr>) -> Option<usize> {
        // Of equals the last one counts here, so they come in reverse.
        let giving = self.strangers.iter().enumerate().rev().filter(|(_, s)| of.is_none_or(|of| of == s.peer));
        giving.max_by_key(|(_, s)| self.count(s.peer)).map(|(i, _)| i)
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
    use std::time::Duration;

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
            self.stream.set_read_timeout(Some(Duration::from_millis(20))).expect("time-out");
            matches!(self.stream.read(&mut [0]), Ok(0))
        }
    }

    struct Street {
        listener: TcpListener,
        door: Arc<Door>,
    }

    impl Street {
        fn new() -> Self {
            Self { listener: TcpListener::bind("127.0.0.1:0").expect("listener"), door: Arc::default() }
        }

        fn come(&self, peer: &str) -> Visitor {
            let stream = TcpStream::connect(self.listener.local_addr().expect("address")).expect("connected");
            let (ours, _) = self.listener.accept().expect("accepted");
            let end = ours.try_clone().expect("a second handle");
            let stay = self.door.enter(peer.parse().expect("address"), end, &|_, why| assert_eq!(why, CROWDED));
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
    fn of_one_address_the_oldest_gives_way_and_others_stay() {
        let street = Street::new();
        let (mut many, mut other) = (street.crowd("10.0.0.1", OF_ONE), street.crowd("10.0.0.2", 2));
        assert!(ended(&mut many).is_empty());
        // The same address as an IPv6 socket has it.
        let newer = [street.come("10.0.0.1"), street.come("::ffff:10.0.0.1")];
        assert_eq!((ended(&mut many), ended(&mut other)), (vec![0, 1], vec![]));
        assert!(newer.into_iter().all(|mut v| !v.is_ended()));
    }

    #[test]
    fn of_all_addresses_the_one_that_has_most_gives_way() {
        let street = Street::new();
        let mut few = street.crowd("10.0.0.1", 2);
        let mut many = [street.crowd("10.0.0.2", OF_ONE), street.crowd("10.0.0.3", OF_ONE - 2)];
        let mut rest: Vec<Visitor> = (0..OF_ALL - 2 * OF_ONE).map(|i| street.come(&format!("10.0.1.{i}"))).collect();
        let mut owner = street.come("10.0.0.9");
        assert!(!owner.is_ended());
        assert_eq!((ended(&mut many[0]), ended(&mut many[1])), (vec![0], vec![]));
        assert_eq!((ended(&mut few), ended(&mut rest)), (vec![], vec![]));
    }

    #[test]
    fn who_is_let_in_or_has_gone_does_not_count() {
        let street = Street::new();
        let mut pages = street.crowd("10.0.0.1", OF_ONE);
        for page in &pages {
            page.stay.let_in();
        }
        let mut more = street.crowd("10.0.0.1", OF_ONE);
        more.truncate(1);
        more.extend(street.crowd("10.0.0.1", OF_ONE - 1));
        assert_eq!((ended(&mut pages), ended(&mut more)), (vec![], vec![]));
    }
}
