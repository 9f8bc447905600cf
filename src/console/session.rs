//! One page's WebSocket: what it says, and what it is told.
//!
//! Two threads share the connection, as one of them always waits: the reader (the connection's own thread) writes nothing, and hands pings to the
//! writer. The first message must be `hello`, with the token if one is asked for.

use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::Deserialize;
use tungstenite::error::ProtocolError;
use tungstenite::protocol::frame::CloseFrame;
use tungstenite::protocol::frame::coding::CloseCode;
use tungstenite::protocol::{Role, WebSocketConfig};
use tungstenite::{Message, WebSocket};

use super::calibration;
use super::commands::Action;
use super::door::Stay;
use super::guard::Access;
use super::http;
use super::hub::{Hub, demand};
use super::outbox::{Next, Outbox};
use super::pair::{Method, Which};
use super::wire::Kind;

/// Longest message of a page, bytes.
const MAX_MESSAGE: usize = 4 * 1024;
/// Messages of a page a second; one that draws sends about thirty.
const MAX_RATE: u32 = 200;
/// Time for the first message.
const HELLO_TIME: Duration = Duration::from_secs(5);
/// A page that says nothing for so long has gone: it answers pings.
const SILENCE: Duration = Duration::from_secs(45);
const PING_EVERY: Duration = Duration::from_secs(15);
/// A connection that takes nothing for so long is ended.
const WRITE_TIME: Duration = Duration::from_secs(10);
/// Pause after a wrong token: with all connections at it, some hundred guesses a second.
const WRONG_TOKEN_PAUSE: Duration = Duration::from_millis(500);
/// Codes of our own with which a WebSocket is closed.
const CLOSE_TOKEN: u16 = 4401;
const CLOSE_FULL: u16 = 4429;

/// What a page says.
#[derive(Debug, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Word {
    Hello {
        token: Option<String>,
    },
    /// What it shows from now on.
    Show(Vec<Part>),
    /// It has dealt with a message of this kind.
    Seen(u64),
    Command {
        id: u32,
        action: Action,
    },
    /// Takes one of the two pictures.
    Take {
        id: u32,
        which: Which,
    },
    /// Runs the two-picture chain on them.
    Chain {
        id: u32,
        method: Method,
    },
    /// Starts, ends or keeps a calibration.
    Calibrate {
        id: u32,
        action: calibration::Action,
    },
}

/// What takes its time.
#[derive(Debug, Clone, PartialEq)]
pub enum Job {
    Command(Action),
    Take(Which),
    Chain(Method),
    Calibrate(calibration::Action),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Part {
    Video,
    Map,
    Log,
    Covisible,
    Calibration,
    Obstacles,
}

impl Part {
    fn bit(self) -> u32 {
        match self {
            Self::Video => demand::VIDEO,
            Self::Map => demand::MAP,
            Self::Log => demand::LOG,
            Self::Covisible => demand::COVISIBLE,
            Self::Calibration => demand::CALIBRATION,
            Self::Obstacles => demand::OBSTACLES,
        }
    }
}

/// Takes a job of a page; the answer goes into its outbox.
pub type Order = Box<dyn Fn(&Arc<Outbox>, u32, Job) + Send + Sync>;

/// The reader's half: tungstenite wants to answer pings and closes itself, in the middle of what the writer writes. A message must be there as a
/// whole by the deadline, however its bytes trickle in.
struct Deaf {
    stream: TcpStream,
    deadline: Instant,
}

impl Read for Deaf {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let left = self.deadline.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(io::ErrorKind::TimedOut.into());
        }
        self.stream.set_read_timeout(Some(left))?;
        self.stream.read(buffer)
    }
}

impl Write for Deaf {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        Ok(buffer.len())
    }
    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn config() -> WebSocketConfig {
    WebSocketConfig::default()
        .max_message_size(Some(MAX_MESSAGE))
        .max_frame_size(Some(MAX_MESSAGE))
        .read_buffer_size(MAX_MESSAGE)
        .write_buffer_size(0)
}

/// Serves a page until it goes. `rest`: bytes that came with the request; `stay`: its place at the door; `refuse` says why a page is sent away.
pub fn run(
    stream: TcpStream,
    rest: Vec<u8>,
    hub: &Hub,
    access: &Access,
    order: &Order,
    stay: &Stay,
    refuse: &dyn Fn(&'static str),
) -> io::Result<()> {
    stream.set_nodelay(true)?;
    stream.set_write_timeout(Some(WRITE_TIME))?;
    let deaf = Deaf { stream: stream.try_clone()?, deadline: Instant::now() + HELLO_TIME };
    let mut reader = WebSocket::from_partially_read(deaf, rest, Role::Server, Some(config()));
    let mut writer = WebSocket::from_raw_socket(stream.try_clone()?, Role::Server, Some(config()));
    match word(reader.read()) {
        Ok(Some(Word::Hello { token })) if access.opens(token.as_deref().unwrap_or("")) => {}
        Ok(Some(Word::Hello { .. })) => {
            refuse("wrong token");
            std::thread::sleep(WRONG_TOKEN_PAUSE);
            return close(&mut writer, CLOSE_TOKEN, "token");
        }
        _ => {
            refuse("no hello");
            return close(&mut writer, CloseCode::Policy.into(), "hello expected");
        }
    }
    let Some(page) = hub.join() else {
        refuse("too many pages");
        return close(&mut writer, CLOSE_FULL, "too many pages");
    };
    stay.let_in();
    page.open();
    hub.greet(&page);
    let (end, taken) = std::thread::scope(|scope| {
        let writing = scope.spawn(|| write(&mut writer, &page));
        let end = listen(&mut reader, hub, &page, order);
        hub.leave(&page);
        (end, writing.join().unwrap_or(true))
    });
    if !taken {
        refuse("takes nothing");
    }
    if let Some((code, reason)) = end {
        if code != u16::from(CloseCode::Normal) {
            refuse(reason);
        }
        let _ = close(&mut writer, code, reason);
    }
    // Both directions; it may be gone already.
    let _ = stream.shutdown(Shutdown::Both);
    Ok(())
}

fn close(writer: &mut WebSocket<TcpStream>, code: u16, reason: &'static str) -> io::Result<()> {
    let frame = CloseFrame { code: code.into(), reason: reason.into() };
    // Whoever has gone needs no reason.
    let _ = writer.close(Some(frame)).and_then(|()| writer.flush());
    // What it has said meanwhile is taken: a connection that is closed over it loses the reason on its way.
    http::linger(writer.get_mut());
    Ok(())
}

/// A message of the page; `None` for what is none of its words.
fn word(message: tungstenite::Result<Message>) -> tungstenite::Result<Option<Word>> {
    message.map(|message| match message {
        Message::Text(text) => serde_json::from_str(text.as_str()).ok(),
        _ => None,
    })
}

/// Until the page goes; with a code if it is its own fault.
fn listen(reader: &mut WebSocket<Deaf>, hub: &Hub, page: &Arc<Outbox>, order: &Order) -> Option<(u16, &'static str)> {
    let (mut second, mut count) = (Instant::now(), 0);
    loop {
        reader.get_mut().deadline = Instant::now() + SILENCE;
        let message = match reader.read() {
            Ok(message) => message,
            // As when a laptop is closed.
            Err(tungstenite::Error::Protocol(ProtocolError::ResetWithoutClosingHandshake)) => return None,
            Err(tungstenite::Error::Capacity(_)) => return Some((CloseCode::Size.into(), "message too large")),
            Err(tungstenite::Error::Protocol(_) | tungstenite::Error::Utf8(_)) => {
                return Some((CloseCode::Protocol.into(), "malformed"));
            }
            Err(_) => return None,
        };
        if second.elapsed() >= Duration::from_secs(1) {
            (second, count) = (Instant::now(), 0);
        }
        count += 1;
        if count > MAX_RATE {
            return Some((CloseCode::Policy.into(), "too many messages"));
        }
        match message {
            Message::Ping(payload) => page.pong(payload.to_vec()),
            Message::Pong(_) => {}
            Message::Close(_) => return Some((CloseCode::Normal.into(), "")),
            message => match word(Ok(message)) {
                Ok(Some(word)) => obey(word, hub, page, order),
                _ => return Some((CloseCode::Policy.into(), "not understood")),
            },
        }
    }
}

fn obey(word: Word, hub: &Hub, page: &Arc<Outbox>, order: &Order) {
    match word {
        Word::Hello { .. } => {}
        Word::Show(parts) => {
            let before = page.demand();
            let bits = parts.iter().fold(0, |bits, part| bits | part.bit());
            page.set_demand(bits);
            let begun = bits & !before;
            if begun & demand::LOG != 0 {
                hub.replay_log(page);
            }
            if begun & demand::MAP != 0 {
                hub.replay(page, &[Kind::Keyframes, Kind::Ties, Kind::Map]);
            }
            if begun & demand::COVISIBLE != 0 {
                hub.replay(page, &[Kind::Covisible]);
            }
            if begun & demand::CALIBRATION != 0 {
                hub.replay(page, &[Kind::Calibration]);
            }
        }
        Word::Seen(number) => {
            if let Some(kind) = Kind::acknowledged(number) {
                page.seen(kind);
            }
        }
        Word::Command { id, action } => order(page, id, Job::Command(action)),
        Word::Take { id, which } => order(page, id, Job::Take(which)),
        Word::Chain { id, method } => order(page, id, Job::Chain(method)),
        Word::Calibrate { id, action } => order(page, id, Job::Calibrate(action)),
    }
}

/// Until the page's outbox is closed or nobody takes what is written; false for a page that is there and took nothing for [`WRITE_TIME`].
fn write(writer: &mut WebSocket<TcpStream>, page: &Outbox) -> bool {
    let mut pinged = Instant::now();
    loop {
        let sent = match page.next(PING_EVERY) {
            Next::Send(message) => writer.send(Message::Binary(message)),
            Next::Pong(payload) => writer.send(Message::Pong(payload.into())),
            Next::Idle => Ok(()),
            Next::Closed => {
                // Where the console ends the reader still waits.
                let _ = writer.get_ref().shutdown(Shutdown::Read);
                return true;
            }
        };
        let sent = sent.and_then(|()| {
            if pinged.elapsed() < PING_EVERY {
                return Ok(());
            }
            pinged = Instant::now();
            writer.send(Message::Ping(tungstenite::Bytes::new()))
        });
        if let Err(error) = sent {
            // The reader wakes, and ends the session.
            let _ = writer.get_ref().shutdown(Shutdown::Both);
            let waited = |e: &io::Error| matches!(e.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut);
            return !matches!(&error, tungstenite::Error::Io(e) if waited(e));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn word(text: &str) -> Option<Word> {
        serde_json::from_str(text).ok()
    }

    #[test]
    fn a_page_has_few_words() {
        assert_eq!(word(r#"{"hello":{}}"#), Some(Word::Hello { token: None }));
        assert_eq!(word(r#"{"show":["video","log"]}"#), Some(Word::Show(vec![Part::Video, Part::Log])));
        assert_eq!(word(r#"{"seen":5}"#), Some(Word::Seen(5)));
        let command = word(r#"{"command":{"id":1,"action":{"do":"reset"}}}"#);
        assert_eq!(command, Some(Word::Command { id: 1, action: Action::Reset {} }));
        let calibrate = |action: &str| word(&format!(r#"{{"calibrate":{{"id":4,"action":{action}}}}}"#));
        let board = calibration::Board { columns: 9, rows: 6, square_m: None, lens: calibration::Lens::Full };
        let start = calibration::Action::Start { board };
        let said = calibrate(r#"{"do":"start","board":{"columns":9,"rows":6}}"#);
        assert_eq!(said, Some(Word::Calibrate { id: 4, action: start }));
        for action in
            [r#"{"do":"start"}"#, r#"{"do":"start","board":{"columns":-9,"rows":6}}"#, r#"{"do":"save","path":"/x"}"#]
        {
            assert_eq!(calibrate(action), None, "{action}");
        }
        for text in
            ["", "{}", r#"{"hello":{"tokens":1}}"#, r#"{"show":["all"]}"#, r#"{"seen":-1}"#, r#"{"seen":1,"show":[]}"#]
        {
            assert_eq!(word(text), None, "{text}");
        }
    }
}
