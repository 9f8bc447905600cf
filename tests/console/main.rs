//! The console as browsers and attackers meet it: `cairn console` and `cairn demo` as processes, HTTP and WebSocket by hand.

mod support;

use std::io::{ErrorKind, Read, Write};
use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::Value;
use tungstenite::Message;

use support::{Console, PATIENCE, Page, Place};

const FRAME: u8 = 5;
const MAP: u8 = 4;
const KEYFRAMES: u8 = 3;
const REPLY: u8 = 7;
const PICTURE: u8 = 8;
const TIES: u8 = 10;
const COVISIBLE: u8 = 11;
const CALIBRATION: u8 = 12;

fn u32_at(bytes: &[u8], at: usize) -> usize {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes")) as usize
}

#[test]
fn foreign_hosts_and_origins_and_what_is_no_request_are_refused() {
    let place = Place::new();
    let console = Console::start(&place, &["--allow-host", "robot.local"]);
    let get = |path: &str, lines: &str| console.raw(format!("GET {path} HTTP/1.1\r\n{lines}\r\n\r\n").as_bytes());
    let here = format!("Host: 127.0.0.1:{}", console.port);
    let upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==";
    for (lines, path, status) in [
        (here.clone(), "/", "200"),
        ("Host: robot.local:7979".into(), "/", "200"),
        ("Host: evil.example".into(), "/", "403"),
        (format!("Host: 127.0.0.1.evil.example\r\n{upgrade}"), "/ws", "403"),
        (format!("{here}\r\nOrigin: http://evil.example"), "/", "403"),
        (format!("{here}\r\nOrigin: null\r\n{upgrade}"), "/ws", "403"),
        (format!("{here}\r\nOrigin: http://127.0.0.1:1\r\n{upgrade}"), "/ws", "403"),
        (format!("{here}\r\nOrigin: http://127.0.0.1:{}\r\n{upgrade}", console.port), "/ws", "101"),
        (here.clone(), "/ws", "426"),
        (here.clone(), "/../../etc/passwd", "404"),
        (format!("{here}\r\nContent-Length: 9"), "/", "400"),
        (format!("{here}\r\nX: {}", "x".repeat(20_000)), "/", "431"),
    ] {
        let answer = get(path, &lines);
        assert!(answer.starts_with(&format!("HTTP/1.1 {status} ")), "{path} {lines}: {answer:.100}");
        if status != "101" {
            for header in ["Content-Security-Policy: default-src 'none'", "X-Frame-Options: DENY", "nosniff"] {
                assert!(answer.contains(header), "{path} {lines}: no {header}");
            }
        }
    }
    assert!(console.raw(b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n").starts_with("HTTP/1.1 405 "));
    assert!(console.raw(&[0x16, 3, 1, 0, 0xff]).starts_with("HTTP/1.1 400 "));
    // A head that never ends.
    let start = Instant::now();
    assert!(console.raw(b"GET / HTTP/1.1\r\nHost: loc").starts_with("HTTP/1.1 408 "));
    assert!(start.elapsed() < Duration::from_secs(8));
    assert!(get("/", &here).starts_with("HTTP/1.1 200 "));
    let said = console.end();
    for why in ["foreign host", "foreign origin", "426", "400", "431", "405", "408"] {
        assert!(said.contains(&format!("\"why\":\"{why}")), "{why} is not in the log: {said}");
    }
}

#[test]
fn a_token_is_asked_for_and_never_written() {
    let place = Place::new();
    let secret = "correct-horse-battery";
    let file = tempfile::NamedTempFile::new().expect("file");
    file.as_file().write_all(secret.as_bytes()).expect("written");
    let console = Console::start(&place, &["--token-file", file.path().to_str().expect("text")]);
    for hello in [r#"{"hello":{}}"#, r#"{"hello":{"token":"wrong-horse-battery"}}"#] {
        let mut page = console.connect();
        page.send(hello);
        assert_eq!(page.closed(), Some(4401), "{hello}");
    }
    let mut page = console.connect();
    page.send(r#"{"show":["video"]}"#);
    assert_eq!(page.closed(), Some(1008), "something else than a hello");
    let mut page = console.connect();
    page.send(&format!(r#"{{"hello":{{"token":"{secret}"}}}}"#));
    assert_eq!(page.state()["link"], "waiting");
    let said = console.end();
    assert!(said.contains("wrong token") && !said.contains("horse"), "{said}");
}

/// They come from one address, as the owner does: behind a tunnel or a proxy all have one.
#[test]
fn strangers_who_say_nothing_lock_nobody_out() {
    let place = Place::new();
    let mut file = tempfile::NamedTempFile::new().expect("file");
    file.write_all(b"correct-horse-battery").expect("written");
    let console = Console::start(&place, &["--token-file", file.path().to_str().expect("text")]);
    let hello = r#"{"hello":{"token":"correct-horse-battery"}}"#;
    let mut first = console.connect();
    first.send(hello);
    first.state();
    let begun = |_| {
        let mut stream = console.stream();
        // One that was ended at once takes nothing.
        let _ = stream.write_all(b"GET / HTTP/1.1\r\nHost: loc");
        stream
    };
    let start = Instant::now();
    let mut strangers: Vec<_> = (0..140).map(begun).collect();
    let request = format!("GET / HTTP/1.1\r\nHost: 127.0.0.1:{}\r\n\r\n", console.port);
    assert!(console.raw(request.as_bytes()).starts_with("HTTP/1.1 200 "));
    let mut page = console.connect();
    page.send(hello);
    assert_eq!(page.state()["link"], "waiting");
    strangers[139].set_nonblocking(true).expect("a flag");
    let newest = strangers[139].read(&mut [0]);
    assert!(newest.is_err_and(|e| e.kind() == ErrorKind::WouldBlock), "the newest one has its time");
    // Those who guess pause for half a second, and hold their connections meanwhile.
    let guess = |_| {
        let mut page = console.connect();
        page.send(r#"{"hello":{"token":"wrong"}}"#);
        page
    };
    let _guessing: Vec<Page> = (0..40).map(guess).collect();
    let mut page = console.connect();
    page.send(hello);
    assert_eq!(page.state()["link"], "waiting");
    // A head has five seconds.
    assert!(start.elapsed() < Duration::from_secs(4), "{:?}", start.elapsed());
    assert!(!matches!(strangers[0].read(&mut [0]), Ok(1..)), "the oldest stranger is ended without an answer");
    assert_eq!(first.state()["link"], "waiting");
    let said = console.end();
    assert!(said.contains("\"why\":\"too many connections\"") && !said.contains("horse"), "{said}");
}

#[test]
fn another_address_without_a_token_is_refused() {
    let run = |arguments: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_cairn")).arg("console").args(arguments).output().expect("run");
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let (code, message) = run(&["--listen", "0.0.0.0:0"]);
    assert!(code == Some(64) && message.contains("--token-file"), "{code:?} {message}");
    let (code, message) = run(&["--token-file", "/nowhere/token"]);
    assert!(code == Some(66) && message.contains("/nowhere/token"), "{code:?} {message}");
    let (code, message) = run(&["--allow-host", "http://robot"]);
    assert!(code == Some(64) && message.contains("--allow-host"), "{code:?} {message}");
}

#[test]
fn malformed_and_oversized_messages_end_their_own_page_only() {
    let place = Place::new();
    let console = Console::start(&place, &[]);
    let mut good = console.page();
    let cases: [(Message, u16); 4] = [
        (Message::text("x".repeat(5000)), 1009),
        (Message::text(r#"{"shutdown":true}"#), 1008),
        (Message::text("{"), 1008),
        (Message::binary(vec![0u8; 100]), 1008),
    ];
    for (message, code) in cases {
        let mut page = console.page();
        page.socket.send(message.clone()).expect("sent");
        assert_eq!(page.closed(), Some(code), "{message:?}");
    }
    // Too many messages.
    let mut page = console.page();
    for _ in 0..300 {
        if page.socket.send(Message::text(r#"{"seen":5}"#)).is_err() {
            break;
        }
    }
    assert!(matches!(page.closed(), Some(1008) | None));
    // Bytes that are no message: without a mask, with reserved bits, of an unknown kind, of 2^62 bytes, a ping that is too long, text that is no
    // UTF-8, and one in parts that are small and together too large.
    let masked = |first: u8, payload: &[u8]| {
        let length = (payload.len() as u16).to_be_bytes();
        [&[first, 0x80 | 126, length[0], length[1], 0, 0, 0, 0], payload].concat()
    };
    let parts = [masked(0x01, &[b'x'; 3000]), masked(0x00, &[b'x'; 3000])].concat();
    for (bytes, code) in [
        (vec![0x81, 1, b'x'], 1002),
        (masked(0xf1, b"{}"), 1002),
        (masked(0x83, b"{}"), 1002),
        ([&[0x81, 0xff, 0x40], [0; 11].as_slice()].concat(), 1009),
        (masked(0x89, &[0; 200]), 1002),
        (masked(0x81, &[0xff, 0xfe]), 1002),
        (parts, 1009),
    ] {
        let mut page = console.page();
        page.socket.get_mut().write_all(&bytes).expect("sent");
        let closed = page.closed();
        assert!(closed == Some(code) || closed.is_none(), "{closed:?}: {:?}", &bytes[..bytes.len().min(16)]);
    }
    // One that never says who it is.
    let start = Instant::now();
    assert_eq!(console.connect().closed(), Some(1008));
    assert!(start.elapsed() < Duration::from_secs(8));
    assert_eq!(good.state()["link"], "waiting");
    let said = console.end();
    for why in ["message too large", "not understood", "too many messages", "malformed", "no hello"] {
        assert!(said.contains(&format!("\"why\":\"{why}\"")), "{why} is not in the log: {said}");
    }
}

#[test]
fn more_pages_than_are_served_are_sent_away_until_one_leaves() {
    let place = Place::new();
    let console = Console::start(&place, &[]);
    let mut pages: Vec<Page> = (0..32).map(|_| console.page()).collect();
    for page in &mut pages {
        assert_eq!(page.state()["link"], "waiting");
    }
    assert_eq!(console.page().closed(), Some(4429));
    assert_eq!(pages[0].state()["link"], "waiting");
    drop(pages.pop());
    let start = Instant::now();
    while let Some(code) = console.page().closed_or(1) {
        assert!(code == 4429 && start.elapsed() < PATIENCE, "{code}");
    }
    assert!(console.end().contains("\"why\":\"too many pages\""));
}

/// Until the system's buffers are full it costs nothing; then it has ten seconds, twice if a part of a message still found room.
#[test]
fn a_page_that_takes_nothing_is_ended_and_the_others_are_not_held_up() {
    let place = Place::new();
    let mut log = tempfile::NamedTempFile::new().expect("file");
    for i in 0..400 {
        let record =
            serde_json::json!({ "level": "INFO", "fields": { "message": format!("{i} {}", "x".repeat(300)) } });
        writeln!(log, "{record}").expect("written");
    }
    let console = Console::start(&place, &["--log-file", log.path().to_str().expect("text")]);
    let mut good = console.page();
    good.send(r#"{"show":["log"]}"#);
    good.next(6);
    let mut stuck = console.page();
    for _ in 0..150 {
        stuck.send(r#"{"show":["log"]}"#);
        stuck.send(r#"{"show":[]}"#);
        std::thread::sleep(Duration::from_millis(20));
    }
    let start = Instant::now();
    let mut slowest = Duration::ZERO;
    // It finds out when it says something.
    while stuck.socket.send(Message::text(r#"{"show":[]}"#)).is_ok() {
        assert!(start.elapsed() < PATIENCE, "it is never ended");
        let asked = Instant::now();
        assert_eq!(good.state()["link"], "waiting");
        slowest = slowest.max(asked.elapsed());
    }
    // Its session ends, and is in the log.
    good.state();
    // Said five times a second.
    assert!(slowest < Duration::from_secs(2), "{slowest:?}");
    assert!(console.end().contains("\"why\":\"takes nothing\""));
}

#[test]
fn pages_see_video_features_map_and_answers_and_a_slow_one_holds_nobody_up() {
    let place = Place::new();
    let console = Console::start(&place, &[]);
    let _demo = place.demo(60);
    let mut page = console.page();
    page.send(r#"{"show":["video"]}"#);
    let mut sequence = 0;
    // The service of the features is found a picture or two after that of the pictures.
    let (mut whole, start) = (0, Instant::now());
    while whole < 10 {
        assert!(start.elapsed() < PATIENCE, "{whole} pictures with features");
        let frame = page.next(FRAME);
        let now = u64::from_le_bytes(frame[8..16].try_into().expect("eight bytes"));
        assert!(now > sequence || sequence == 0, "{now} after {sequence}");
        sequence = now;
        let features = u32_at(&frame, 4);
        assert_eq!((u32_at(&frame, 24), u32_at(&frame, 28)), (640, 480));
        assert!(frame[32 + 16 * features..].starts_with(&[0xff, 0xd8, 0xff]), "no JPEG behind {features} features");
        whole += usize::from(features > 50);
        page.send(r#"{"seen":5}"#);
    }
    // Only now: a map that came among the pictures would not be answered, and no other would follow.
    page.send(r#"{"show":["video","map"]}"#);
    let map = page.next(MAP);
    assert_eq!(map.len(), 24 + 16 * u32_at(&map, 4));
    page.send(r#"{"seen":4}"#);
    let start = Instant::now();
    let tracked = loop {
        let keyframes = page.next(KEYFRAMES);
        if u32_at(&keyframes, 4) >= 2 {
            break keyframes;
        }
        assert!(start.elapsed() < PATIENCE, "no keyframes");
    };
    assert_eq!(tracked.len(), 24 + 32 * u32_at(&tracked, 4));
    let ties = page.next(TIES);
    assert_eq!(ties.len(), 24 + 20 * u32_at(&ties, 4));
    page.send(r#"{"show":["video","map","covisible"]}"#);
    let covisible = page.next(COVISIBLE);
    let pairs = u32_at(&covisible, 4);
    assert!(pairs >= 1 && covisible.len() == 24 + 20 * pairs, "{pairs} pairs in {} bytes", covisible.len());
    let edge = |i: usize, word: usize| u32_at(&covisible, 24 + 20 * i + 4 * word);
    assert!((0..pairs).all(|i| edge(i, 0) < edge(i, 1) && edge(i, 2) > 0 && edge(i, 4) == 0));
    page.send(r#"{"seen":11}"#);
    page.send(r#"{"show":["video","map"]}"#);
    // Before a command, whose connections go when it is answered.
    let subscriptions = place.subscriptions();
    assert!(subscriptions >= 5, "{subscriptions}");
    page.send(r#"{"command":{"id":6,"action":{"do":"camera_controls"}}}"#);
    let reply: Value = serde_json::from_slice(&page.next(REPLY)[8..]).expect("JSON");
    assert_eq!(
        (&reply["ok"], &reply["terminal"]),
        (&false.into(), &"cairn command --prefix robot camera".into()),
        "{reply}"
    );
    assert!(
        reply["text"].as_str().is_some_and(|t| t.ends_with("has no exposure, gain or focus that could be set")),
        "{reply}"
    );
    // One that never reads and never acknowledges, and twenty that do: one subscription of each service for all.
    let mut slow = console.page();
    slow.send(r#"{"show":["video","map"]}"#);
    let mut pages: Vec<Page> = (0..20).map(|_| console.page()).collect();
    for page in &mut pages {
        page.send(r#"{"show":["video"]}"#);
    }
    for _ in 0..5 {
        for page in &mut pages {
            page.next(FRAME);
            page.send(r#"{"seen":5}"#);
        }
    }
    assert_eq!(place.subscriptions(), subscriptions, "pages cost subscriptions");
    // What waits for the slow one is what a page may have under way, however long ago it was.
    let waiting = slow.drain(FRAME);
    assert!((1..=2).contains(&waiting), "{waiting} pictures");
    page.send(r#"{"command":{"id":7,"action":{"do":"reset"}}}"#);
    let reply: Value = serde_json::from_slice(&page.next(REPLY)[8..]).expect("JSON");
    assert_eq!((&reply["id"], &reply["ok"]), (&7.into(), &true.into()), "{reply}");
    assert!(reply["terminal"].as_str().is_some_and(|t| t.ends_with(" reset")), "{reply}");
    page.send(r#"{"command":{"id":8,"action":{"do":"save_map","path":"map.ply"}}}"#);
    let reply: Value = serde_json::from_slice(&page.next(REPLY)[8..]).expect("JSON");
    assert_eq!((&reply["id"], &reply["ok"]), (&8.into(), &false.into()), "{reply}");
}

#[test]
fn maps_are_kept_listed_and_gone_on_in_from_a_page() {
    let place = Place::new();
    let console = Console::start(&place, &[]);
    let _demo = place.demo(90);
    let mut page = console.page();
    page.send(r#"{"show":["map"]}"#);
    page.state_until("connected");
    let start = Instant::now();
    while u32_at(&page.next(KEYFRAMES), 4) < 4 {
        page.send(r#"{"seen":3}"#);
        assert!(start.elapsed() < PATIENCE, "no keyframes");
    }
    let mut ask = |id: u32, action: &str, ok: bool| {
        page.send(&format!(r#"{{"command":{{"id":{id},"action":{action}}}}}"#));
        let reply: Value = serde_json::from_slice(&page.next(REPLY)[8..]).expect("JSON");
        assert_eq!((&reply["id"], &reply["ok"]), (&id.into(), &ok.into()), "{action}: {reply}");
        (reply["text"].as_str().expect("text").to_owned(), reply["terminal"].as_str().expect("text").to_owned())
    };
    let (_, terminal) = ask(1, r#"{"do":"store_map","name":"room"}"#, true);
    assert!(terminal.ends_with(" save room"), "{terminal}");
    for (id, name) in [(2, "../room"), (3, "/tmp/room"), (4, "none")] {
        let (text, _) = ask(id, &format!(r#"{{"do":"load_map","name":"{name}"}}"#), false);
        assert!(text.contains(name), "{text}");
    }
    assert!(ask(5, r#"{"do":"list_maps"}"#, true).0.starts_with("room "));
    assert!(ask(6, r#"{"do":"load_map","name":"room"}"#, true).0.contains("room.map"));
    assert!(ask(7, r#"{"do":"list_maps"}"#, true).0.ends_with("the current one"));
    ask(8, r#"{"do":"localise_only","on":true}"#, true);
    ask(9, r#"{"do":"localise_only","on":false}"#, true);
    ask(10, r#"{"do":"new_map","name":"other"}"#, true);
    assert!(ask(11, r#"{"do":"store_map","name":""}"#, true).0.contains("other.map"));
}

#[test]
fn two_pictures_are_taken_and_go_through_the_chain() {
    let place = Place::new();
    let console = Console::start(&place, &[]);
    let mut page = console.page();
    let reply = |page: &mut Page| -> Value { serde_json::from_slice(&page.next(REPLY)[8..]).expect("JSON") };
    let method = r#"{"detector":"fast","matcher":"gradients","guided":false}"#;
    page.send(&format!(r#"{{"chain":{{"id":1,"method":{method}}}}}"#));
    assert_eq!(reply(&mut page)["text"], "take picture A first");
    let _demo = place.demo(60);
    page.state_until("connected");
    for which in ["a", "b"] {
        page.send(&format!(r#"{{"take":{{"id":2,"which":"{which}"}}}}"#));
        let picture = page.next(PICTURE);
        let said = 8 + u32_at(&picture, 4);
        assert_eq!(picture[8..said], *format!(r#"{{"name":"{which}"}}"#).as_bytes());
        assert!(picture[said..].starts_with(b"\x89PNG"));
        assert_eq!(reply(&mut page)["ok"], true);
        std::thread::sleep(Duration::from_millis(700));
    }
    page.send(&format!(r#"{{"chain":{{"id":3,"method":{method}}}}}"#));
    let said = reply(&mut page);
    assert_eq!((&said["id"], &said["ok"]), (&3.into(), &true.into()), "{said}");
    let text = said["text"].as_str().expect("text");
    for step in ["corners", "matches", "F ", "outcome"] {
        assert!(text.lines().any(|line| line.starts_with(step)), "{step} is not in {text}");
    }
    assert!(said["terminal"].as_str().is_some_and(|t| t.starts_with("cairn twoview a.png b.png")), "{said}");
}

#[test]
fn a_calibration_is_seen_by_all_pages_and_finds_the_board() {
    let place = Place::new();
    let console = Console::start(&place, &[]);
    let told = |page: &mut Page| -> Value { serde_json::from_slice(&page.next(CALIBRATION)[8..]).expect("JSON") };
    let order = |page: &mut Page, id: u32, action: &str| -> Value {
        page.send(&format!(r#"{{"calibrate":{{"id":{id},"action":{action}}}}}"#));
        let reply: Value = serde_json::from_slice(&page.next(REPLY)[8..]).expect("JSON");
        assert_eq!(reply["id"], id, "{reply}");
        reply
    };
    let start = r#"{"do":"start","board":{"columns":9,"rows":6,"square_m":0.03,"lens":"full"}}"#;
    let (mut page, mut other) = (console.page(), console.page());
    for page in [&mut page, &mut other] {
        page.send(r#"{"show":["calibration"]}"#);
        assert_eq!(told(page)["phase"], "idle");
    }
    let refused = order(&mut page, 1, &start.replace("9,", "90,"));
    assert!(refused["text"].as_str().is_some_and(|t| t.contains("90x6")), "{refused}");
    let _demo = place.demo_with(60, &["--board"]);
    page.state_until("connected");
    let reply = order(&mut page, 2, start);
    assert_eq!(reply["ok"], true, "{reply}");
    assert_eq!(reply["terminal"], "cairn calibrate --camera auto --pattern 9x6 --square 0.03");
    let refused = order(&mut other, 3, start);
    assert!(refused["ok"] == false && refused["text"].as_str().is_some_and(|t| t.contains("under way")), "{refused}");
    let begun = Instant::now();
    let mut seen = told(&mut other);
    while seen["glance"]["corners"].as_array().is_none_or(|rows| rows.len() != 6) {
        assert!(begun.elapsed() < PATIENCE, "no board: {seen}");
        assert!(seen["phase"] != "failed", "{seen}");
        seen = told(&mut other);
    }
    assert_eq!((&seen["phase"], &seen["by"], &seen["run"]), (&"running".into(), &2.into(), &1.into()));
    assert_eq!(seen["glance"]["corners"][5].as_array().map(Vec::len), Some(18));
    // The simulator has no identity, and no camera is open.
    assert!(seen["camera"].is_null() && seen["guidance"]["enough"] == 15, "{seen}");
    assert_eq!(order(&mut other, 4, r#"{"do":"cancel"}"#)["ok"], true);
    while told(&mut page)["phase"] != "idle" {
        assert!(begun.elapsed() < PATIENCE, "the first page does not hear of it");
    }
}

#[test]
fn a_killed_daemon_is_told_and_the_next_one_is_found() {
    let place = Place::new();
    let console = Console::start(&place, &[]);
    let mut page = console.page();
    assert_eq!(page.state()["link"], "waiting");
    let first = place.demo(60);
    let run = page.state_until("connected")["daemon"]["run_id"].clone();
    drop(first); // kill -9
    page.state_until("waiting");
    let _second = place.demo(60);
    let again = page.state_until("connected")["daemon"]["run_id"].clone();
    assert!(run.is_string() && again != run, "{run} {again}");
    page.send(r#"{"show":["video"]}"#);
    page.next(FRAME);
}
