//! Processes in a place of their own, and a page by hand.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use serde_json::Value;
use tungstenite::{Message, WebSocket};

/// Every wait ends after this; CI's two cores paint the simulated room in some seconds.
pub const PATIENCE: Duration = Duration::from_secs(40);

/// An iceoryx2 root and prefix of one test.
pub struct Place {
    root: PathBuf,
    ipc_prefix: String,
}

impl Place {
    pub fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let name = format!("cc{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
        Self { root: Path::new("/tmp").join(&name), ipc_prefix: format!("{name}_") }
    }

    fn cairn(&self) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cairn"));
        command
            .env("CAIRN_IPC_ROOT", &self.root)
            .env("CAIRN_IPC_PREFIX", &self.ipc_prefix)
            .env("CAIRN_PREFIX", "robot");
        command.stdin(Stdio::null()).stdout(Stdio::null());
        command
    }

    /// A daemon on the simulator; killed when dropped.
    pub fn demo(&self, seconds: u32) -> Running {
        self.demo_with(seconds, &[])
    }

    pub fn demo_with(&self, seconds: u32, arguments: &[&str]) -> Running {
        let output = self.root.join("demo");
        let mut command = self.cairn();
        command.args(["demo", "--quiet", "--seconds", &seconds.to_string(), "--output"]).arg(output).args(arguments);
        Running(command.stderr(Stdio::null()).spawn().expect("demo"))
    }

    /// Subscriptions to all services, of all processes.
    pub fn subscriptions(&self) -> usize {
        let entries = std::fs::read_dir("/dev/shm").expect("/dev/shm").flatten();
        let name = |entry: std::fs::DirEntry| entry.file_name().into_string().unwrap_or_default();
        entries.map(name).filter(|n| n.starts_with(&self.ipc_prefix) && n.ends_with(".connection")).count()
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.root);
        for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&self.ipc_prefix) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

/// A process that does not outlive its test.
pub struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// `cairn console` on a port of its own.
pub struct Console {
    process: Running,
    pub port: u16,
    said: BufReader<std::process::ChildStderr>,
}

impl Console {
    pub fn start(place: &Place, arguments: &[&str]) -> Self {
        let mut command = place.cairn();
        command.args(["console", "--listen", "127.0.0.1:0"]).args(arguments).stderr(Stdio::piped());
        let mut process = Running(command.spawn().expect("console"));
        let mut said = BufReader::new(process.0.stderr.take().expect("stderr"));
        let mut line = String::new();
        while !line.contains("http://") {
            line.clear();
            assert!(said.read_line(&mut line).expect("a line") > 0, "the console has ended");
        }
        let port = line.trim().trim_end_matches('/').rsplit(':').next().and_then(|p| p.parse().ok()).expect("port");
        Self { process, port, said }
    }

    /// A connection on which nothing was said so far.
    pub fn stream(&self) -> TcpStream {
        let stream = TcpStream::connect(("127.0.0.1", self.port)).expect("connected");
        stream.set_read_timeout(Some(PATIENCE)).expect("time-out");
        stream
    }

    /// Sends bytes, and reads the answer to its end, or what comes of it.
    pub fn raw(&self, bytes: &[u8]) -> String {
        let mut stream = self.stream();
        // It may refuse before it has read all.
        let _ = stream.write_all(bytes);
        let mut answer = Vec::new();
        let mut chunk = [0; 4096];
        while let Ok(n @ 1..) = stream.read(&mut chunk) {
            answer.extend_from_slice(&chunk[..n]);
            if answer.starts_with(b"HTTP/1.1 101") {
                break;
            }
        }
        String::from_utf8_lossy(&answer).into_owned()
    }

    /// A WebSocket that has said nothing so far.
    pub fn connect(&self) -> Page {
        let url = format!("ws://127.0.0.1:{}/ws", self.port);
        let (socket, _) = tungstenite::client(url, self.stream()).expect("a WebSocket");
        Page { socket }
    }

    /// A page that was let in.
    pub fn page(&self) -> Page {
        let mut page = self.connect();
        page.send(r#"{"hello":{}}"#);
        page
    }

    /// Ends it as systemd would; what it said.
    pub fn end(mut self) -> String {
        let id = self.process.0.id().to_string();
        assert!(Command::new("kill").args(["-TERM", &id]).status().expect("kill").success());
        let start = Instant::now();
        while self.process.0.try_wait().expect("waited").is_none() {
            assert!(start.elapsed() < PATIENCE, "the console does not end");
            std::thread::sleep(Duration::from_millis(20));
        }
        let mut said = String::new();
        self.said.read_to_string(&mut said).expect("text");
        said
    }
}

/// A page.
pub struct Page {
    pub socket: WebSocket<TcpStream>,
}

impl Page {
    pub fn send(&mut self, text: &str) {
        self.socket.send(Message::text(text)).expect("sent");
    }

    /// The next message of this kind.
    pub fn next(&mut self, kind: u8) -> Vec<u8> {
        let start = Instant::now();
        loop {
            assert!(start.elapsed() < PATIENCE, "no message of kind {kind}");
            match self.socket.read().expect("a message") {
                Message::Binary(bytes) if bytes.first() == Some(&kind) => return bytes.to_vec(),
                _ => {}
            }
        }
    }

    /// Messages of a kind until nothing of it comes for a second.
    pub fn drain(&mut self, kind: u8) -> usize {
        let (mut count, mut last) = (0, Instant::now());
        while last.elapsed() < Duration::from_secs(1) {
            if let Message::Binary(bytes) = self.socket.read().expect("a message")
                && bytes.first() == Some(&kind)
            {
                (count, last) = (count + 1, Instant::now());
            }
        }
        count
    }

    pub fn state(&mut self) -> Value {
        serde_json::from_slice(&self.next(1)[8..]).expect("JSON")
    }

    /// The first state with this link.
    pub fn state_until(&mut self, link: &str) -> Value {
        let start = Instant::now();
        loop {
            let state = self.state();
            if state["link"] == link {
                return state;
            }
            assert!(start.elapsed() < PATIENCE, "never {link}: {state}");
        }
    }

    /// The code with which it is closed; `None` once this many messages have come.
    pub fn closed_or(&mut self, messages: usize) -> Option<u16> {
        for _ in 0..messages {
            if let Message::Close(frame) = self.socket.read().expect("a message") {
                return frame.map(|f| f.code.into());
            }
        }
        None
    }

    /// The code with which it was closed; `None` if the connection just ended.
    pub fn closed(&mut self) -> Option<u16> {
        let start = Instant::now();
        while start.elapsed() < PATIENCE {
            match self.socket.read() {
                Ok(Message::Close(frame)) => return frame.map(|f| f.code.into()),
                Ok(_) => {}
                Err(_) => return None,
            }
        }
        panic!("it was not closed");
    }
}
