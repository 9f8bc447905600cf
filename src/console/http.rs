//! One request of HTTP/1.1 and its answer; the connection ends with it, or becomes a WebSocket.

use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::time::{Duration, Instant};

use super::assets::{Asset, Assets};

/// Longest head of a request, bytes; browsers send under two thousand.
const MAX_HEAD: usize = 8 * 1024;
/// Most headers.
const MAX_HEADERS: usize = 64;
/// Time for a head to arrive as a whole.
const HEAD_TIME: Duration = Duration::from_secs(5);

/// Time for an answer to be taken as a whole.
const SEND_TIME: Duration = Duration::from_secs(10);
/// How long a refused request is read on.
const LINGER: Duration = Duration::from_millis(300);

/// Of every answer. Scripts, styles and connections are the page's own; nothing may frame it or read it from elsewhere.
const HEADERS: &str = "Content-Security-Policy: default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; \
img-src 'self' blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'\r\n\
X-Content-Type-Options: nosniff\r\n\
X-Frame-Options: DENY\r\n\
Referrer-Policy: no-referrer\r\n\
Cross-Origin-Opener-Policy: same-origin\r\n\
Cross-Origin-Resource-Policy: same-origin\r\n\
Permissions-Policy: camera=(), geolocation=(), microphone=(), usb=()\r\n\
Connection: close\r\n";

/// What is asked for.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Request {
    pub is_head: bool,
    /// Without its query.
    pub path: String,
    pub host: String,
    pub origin: Option<String>,
    pub takes_gzip: bool,
    pub known_etag: Option<String>,
    /// `Sec-WebSocket-Key` of a proper request for a WebSocket.
    pub websocket_key: Option<String>,
    /// Bytes behind the head that were read with it.
    pub rest: Vec<u8>,
}

/// Why there is no request to answer.
#[derive(Debug)]
pub enum Bad {
    /// Status line and a sentence for it.
    Refuse(&'static str, &'static str),
    /// The other side has gone, or says nothing.
    Gone,
}

/// Reads a request's head from a connection.
pub fn read(stream: &mut TcpStream) -> Result<Request, Bad> {
    let start = Instant::now();
    let mut head = Vec::with_capacity(2048);
    let mut chunk = [0; 2048];
    loop {
        if let Some(request) = parse(&head)? {
            return Ok(request);
        }
        if head.len() > MAX_HEAD {
            return Err(Bad::Refuse("431 Request Header Fields Too Large", "The request is too large."));
        }
        let Some(left) = HEAD_TIME.checked_sub(start.elapsed()).filter(|left| !left.is_zero()) else {
            return Err(Bad::Refuse("408 Request Timeout", "The request took too long."));
        };
        let read = stream.set_read_timeout(Some(left)).and_then(|()| stream.read(&mut chunk));
        match read {
            Ok(0) => return Err(Bad::Gone),
            Ok(n) => head.extend_from_slice(&chunk[..n]),
            Err(e)
                if matches!(
                    e.kind(),
                    io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut | io::ErrorKind::Interrupted
                ) => {}
            Err(_) => return Err(Bad::Gone),
        }
    }
}

/// `None` while the head has not arrived as a whole.
fn parse(bytes: &[u8]) -> Result<Option<Request>, Bad> {
    const MALFORMED: Bad = Bad::Refuse("400 Bad Request", "The request is malformed.");
    let mut headers = [httparse::EMPTY_HEADER; MAX_HEADERS];
    let mut parsed = httparse::Request::new(&mut headers);
    let length = match parsed.parse(bytes) {
        Ok(httparse::Status::Complete(length)) => length,
        Ok(httparse::Status::Partial) => return Ok(None),
        Err(_) => return Err(MALFORMED),
    };
    let is_head = match parsed.method {
        Some("GET") => false,
        Some("HEAD") => true,
        _ => return Err(Bad::Refuse("405 Method Not Allowed", "Only GET is answered.")),
    };
    let path = parsed.path.unwrap_or("/").split('?').next().unwrap_or("/").to_owned();
    let mut request = Request { is_head, path, rest: bytes[length..].to_vec(), ..Request::default() };
    let (mut hosts, mut upgrade, mut key, mut version) = (0, false, None, false);
    for header in parsed.headers.iter() {
        let value = std::str::from_utf8(header.value).map_err(|_| MALFORMED)?.trim();
        let holds =
            |word: &str| value.split(',').any(|v| v.trim().split(';').next().unwrap_or("").eq_ignore_ascii_case(word));
        match header.name.to_ascii_lowercase().as_str() {
            "host" => (hosts, request.host) = (hosts + 1, value.to_owned()),
            // A second origin is as foreign as a wrong one.
            "origin" if request.origin.is_some() => request.origin = Some(String::new()),
            "origin" => request.origin = Some(value.to_owned()),
            "accept-encoding" => request.takes_gzip = holds("gzip"),
            "if-none-match" => request.known_etag = Some(value.to_owned()),
            "upgrade" => upgrade = holds("websocket"),
            "sec-websocket-key" => key = Some(value.to_owned()),
            "sec-websocket-version" => version = value == "13",
            "transfer-encoding" => return Err(MALFORMED),
            "content-length" if value != "0" => return Err(MALFORMED),
            _ => {}
        }
    }
    if hosts != 1 {
        return Err(MALFORMED);
    }
    request.websocket_key = key.filter(|key| upgrade && version && key.len() == 24 && !is_head);
    Ok(Some(request))
}

/// An answer of one sentence.
pub fn say(stream: &mut TcpStream, status: &str, sentence: &str) -> io::Result<()> {
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: text/plain; charset=utf-8\r\nContent-Length: {}\r\nCache-Control: no-store\r\n{HEADERS}\r\n",
        sentence.len() + 1
    );
    send(stream, &[head.as_bytes(), sentence.as_bytes(), b"\n"].concat())
}

/// However slowly the other side takes it, it ends in [`SEND_TIME`].
fn send(stream: &mut TcpStream, mut bytes: &[u8]) -> io::Result<()> {
    let start = Instant::now();
    while !bytes.is_empty() {
        let left = SEND_TIME.saturating_sub(start.elapsed());
        if left.is_zero() {
            return Err(io::ErrorKind::TimedOut.into());
        }
        stream.set_write_timeout(Some(left))?;
        match stream.write(bytes) {
            Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
            Ok(n) => bytes = &bytes[n..],
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(())
}

/// Takes what the other side still sends, for a moment: a connection that is closed over unread bytes may lose the answer on its way.
pub fn linger(stream: &mut TcpStream) {
    let start = Instant::now();
    let _ = stream.shutdown(Shutdown::Write).and_then(|()| stream.set_read_timeout(Some(LINGER)));
    let mut chunk = [0; 2048];
    while start.elapsed() < LINGER && matches!(stream.read(&mut chunk), Ok(1..)) {}
}

/// A part of the page.
pub fn serve(stream: &mut TcpStream, request: &Request, assets: &Assets) -> io::Result<()> {
    let Some(asset) = assets.find(&request.path) else {
        return say(stream, "404 Not Found", "There is nothing here. The console is at /");
    };
    let known = request.known_etag.as_ref().is_some_and(|known| known.contains(&asset.etag));
    let etag = &asset.etag;
    let fixed = format!("ETag: {etag}\r\nCache-Control: no-cache\r\nVary: Accept-Encoding\r\n{HEADERS}");
    if known {
        return send(stream, format!("HTTP/1.1 304 Not Modified\r\n{fixed}\r\n").as_bytes());
    }
    let (body, encoding) = content(asset, request.takes_gzip)?;
    let head = format!(
        "HTTP/1.1 200 OK\r\nContent-Type: {}\r\nContent-Length: {}\r\n{encoding}{fixed}\r\n",
        asset.media_type,
        body.len()
    );
    send(stream, head.as_bytes())?;
    if request.is_head { Ok(()) } else { send(stream, &body) }
}

fn content(asset: &Asset, takes_gzip: bool) -> io::Result<(std::borrow::Cow<'_, [u8]>, &'static str)> {
    if takes_gzip { Ok(((&asset.gzip).into(), "Content-Encoding: gzip\r\n")) } else { Ok((asset.plain()?.into(), "")) }
}

/// The connection becomes a WebSocket.
pub fn upgrade(stream: &mut TcpStream, key: &str) -> io::Result<()> {
    let accept = tungstenite::handshake::derive_accept_key(key.as_bytes());
    let head = format!(
        "HTTP/1.1 101 Switching Protocols\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Accept: {accept}\r\n\r\n"
    );
    send(stream, head.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> Result<Option<Request>, &'static str> {
        parse(text.as_bytes()).map_err(|bad| match bad {
            Bad::Refuse(status, _) => status,
            Bad::Gone => "gone",
        })
    }

    #[test]
    fn a_head_is_read_once_it_is_whole() {
        let text = "GET /style.css?v=1 HTTP/1.1\r\nHost: localhost\r\nAccept-Encoding: br, gzip;q=0.8\r\n\r\n";
        for end in 0..text.len() {
            assert_eq!(parsed(&text[..end]), Ok(None), "{end}");
        }
        let request = parsed(text).expect("good").expect("whole");
        assert_eq!(
            (request.path.as_str(), request.host.as_str(), request.takes_gzip),
            ("/style.css", "localhost", true)
        );
    }

    #[test]
    fn what_is_no_plain_request_is_refused() {
        let with = |line: &str| parsed(&format!("GET / HTTP/1.1\r\nHost: a\r\n{line}\r\n\r\n")).map(|_| ());
        assert_eq!(with("Accept: */*"), Ok(()));
        for line in ["Host: b", "Content-Length: 5", "Transfer-Encoding: chunked", "no colon", "X: \u{1}"] {
            assert_eq!(with(line), Err("400 Bad Request"), "{line}");
        }
        assert_eq!(parsed("GET / HTTP/1.1\r\n\r\n"), Err("400 Bad Request"), "no host");
        assert_eq!(parsed("POST / HTTP/1.1\r\nHost: a\r\n\r\n"), Err("405 Method Not Allowed"));
        assert_eq!(parsed("\u{16}\u{3}\u{1}\0"), Err("400 Bad Request"), "TLS");
    }

    #[test]
    fn a_websocket_asks_properly_or_is_none() {
        let head = |lines: &str| format!("GET /ws HTTP/1.1\r\nHost: a\r\nConnection: Upgrade\r\n{lines}\r\n\r\n");
        let key = |lines: &str| parsed(&head(lines)).expect("good").expect("whole").websocket_key;
        let good = "Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==";
        assert_eq!(key(good).as_deref(), Some("dGhlIHNhbXBsZSBub25jZQ=="));
        assert_eq!(key(&good.replace("13", "8")), None);
        assert_eq!(key(&good.replace("websocket", "h2c")), None);
        assert_eq!(key(&good.replace("dGhl", "")), None);
    }
}
