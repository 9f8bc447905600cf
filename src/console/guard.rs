//! Who may speak to the console.
//!
//! - `Host` must name this machine: an address, `localhost`, or a name given with `--allow-host`. A page of elsewhere whose name was turned to
//!   this address (DNS rebinding) comes with its own name.
//! - `Origin`, which browsers send with every WebSocket, must be the page's own. Programs send none.
//! - A token, compared in constant time, in the first message of the WebSocket: never in an address, so in no log and no history.

use std::net::{IpAddr, SocketAddr};
use std::path::Path;

use super::ConsoleError;

/// Shortest secret, characters: 16 of base64 are 96 bits.
const MIN_TOKEN: usize = 16;
/// Longest secret, bytes; what is compared has this length.
const MAX_TOKEN: usize = 256;

/// A secret. Never printed.
#[derive(Clone)]
pub struct Token(Vec<u8>);

impl std::fmt::Debug for Token {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Token(..)")
    }
}

impl Token {
    /// The file's text without white space around it.
    pub fn load(path: &Path) -> Result<Self, ConsoleError> {
        use std::os::unix::fs::PermissionsExt;
        let fault = |reason: String| ConsoleError::TokenFile { path: path.to_owned(), reason };
        let permissions = std::fs::metadata(path).map_err(|e| fault(e.to_string()))?.permissions();
        if permissions.mode() & 0o007 != 0 {
            return Err(fault("every user of this machine may read or write it: `chmod 600` it".into()));
        }
        let text = std::fs::read_to_string(path).map_err(|e| fault(e.to_string()))?;
        Self::new(text.trim()).map_err(fault)
    }

    /// A secret that is long enough to be none to guess.
    pub fn new(text: &str) -> Result<Self, String> {
        match text.len() {
            MIN_TOKEN..=MAX_TOKEN => Ok(Self(text.as_bytes().to_vec())),
            n => {
                Err(format!("a token of {n} bytes; give {MIN_TOKEN} to {MAX_TOKEN}, such as of `openssl rand -hex 16`"))
            }
        }
    }

    /// Takes as long whatever is given, and wherever it differs.
    fn is(&self, given: &str) -> bool {
        let given = given.as_bytes();
        let mut differs = usize::from(given.len() != self.0.len());
        for i in 0..MAX_TOKEN {
            let byte = |text: &[u8]| text.get(i).copied().unwrap_or(0);
            differs |= usize::from(std::hint::black_box(byte(given) ^ byte(&self.0)));
        }
        std::hint::black_box(differs) == 0
    }
}

/// The rules.
#[derive(Debug, Clone)]
pub struct Access {
    token: Option<Token>,
    /// Lower case.
    names: Vec<String>,
    /// Only this machine can connect.
    loopback: bool,
}

/// Why a request is refused, for the log and the answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refused {
    ForeignHost,
    ForeignOrigin,
}

impl Refused {
    /// For the log.
    pub fn name(self) -> &'static str {
        match self {
            Self::ForeignHost => "foreign host",
            Self::ForeignOrigin => "foreign origin",
        }
    }

    pub fn sentence(self) -> &'static str {
        match self {
            Self::ForeignHost => {
                "This console does not answer to that host name. Open it by its address, or start it with --allow-host NAME."
            }
            Self::ForeignOrigin => "This console does not answer pages of other sites.",
        }
    }
}

impl Access {
    pub fn new(address: SocketAddr, token: Option<Token>, names: &[String]) -> Result<Self, ConsoleError> {
        let loopback = address.ip().is_loopback();
        if !loopback && token.is_none() {
            return Err(ConsoleError::NeedsToken(address));
        }
        for name in names {
            let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '.' | '_');
            if name.is_empty() || !name.chars().all(plain) {
                return Err(ConsoleError::HostName(name.clone()));
            }
        }
        Ok(Self { token, names: names.iter().map(|n| n.to_ascii_lowercase()).collect(), loopback })
    }

    pub fn needs_token(&self) -> bool {
        self.token.is_some()
    }

    /// Whether this token opens the console; any does where none is asked for.
    pub fn opens(&self, given: &str) -> bool {
        self.token.as_ref().is_none_or(|token| token.is(given))
    }

    /// `host` and `origin` as the request's headers have them.
    pub fn judge(&self, host: &str, origin: Option<&str>) -> Result<(), Refused> {
        if !self.answers_to(host) {
            return Err(Refused::ForeignHost);
        }
        let Some(origin) = origin else { return Ok(()) };
        let authority = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"));
        match authority {
            Some(authority) if authority.eq_ignore_ascii_case(host) => Ok(()),
            _ => Err(Refused::ForeignOrigin),
        }
    }

    fn answers_to(&self, host: &str) -> bool {
        let name = without_port(host);
        let literal = name.strip_prefix('[').and_then(|n| n.strip_suffix(']')).unwrap_or(name);
        if let Ok(ip) = literal.parse::<IpAddr>() {
            // Nobody can turn an address to another machine.
            return !self.loopback || ip.is_loopback();
        }
        let name = name.to_ascii_lowercase();
        name == "localhost" || self.names.contains(&name)
    }
}

fn without_port(host: &str) -> &str {
    match host.rsplit_once(':') {
        Some((name, port)) if !port.is_empty() && port.bytes().all(|b| b.is_ascii_digit()) => name,
        _ => host,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn access(address: &str, names: &[&str]) -> Access {
        let token = Token::new("0123456789abcdef").expect("token");
        let names: Vec<String> = names.iter().map(|n| (*n).into()).collect();
        Access::new(address.parse().expect("address"), Some(token), &names).expect("access")
    }

    #[test]
    fn only_names_of_this_machine_are_answered() {
        let here = access("127.0.0.1:7979", &["Robot.local"]);
        for host in ["127.0.0.1:7979", "localhost:7979", "localhost", "[::1]:7979", "robot.LOCAL:7979", "127.0.0.1"] {
            assert_eq!(here.judge(host, None), Ok(()), "{host}");
        }
        for host in [
            "evil.example",
            "evil.example:7979",
            "",
            "127.0.0.1.evil.example",
            "localhost.evil.example",
            "192.168.1.5:7979",
        ] {
            assert_eq!(here.judge(host, None), Err(Refused::ForeignHost), "{host}");
        }
        let open = access("0.0.0.0:7979", &[]);
        assert_eq!(open.judge("192.168.1.5:7979", None), Ok(()));
        assert_eq!(open.judge("robot.local:7979", None), Err(Refused::ForeignHost));
    }

    #[test]
    fn only_the_pages_own_origin_is_answered() {
        let here = access("127.0.0.1:7979", &[]);
        let judge = |origin| here.judge("localhost:7979", Some(origin));
        assert_eq!(judge("http://localhost:7979"), Ok(()));
        let foreign = [
            "http://evil.example",
            "null",
            "",
            "http://localhost:8080",
            "http://localhost",
            "file://",
            "http://localhost:7979.evil.example",
        ];
        for origin in foreign {
            assert_eq!(judge(origin), Err(Refused::ForeignOrigin), "{origin}");
        }
    }

    #[test]
    fn another_machine_needs_a_token_and_a_short_one_is_refused() {
        let open = Access::new("0.0.0.0:7979".parse().expect("address"), None, &[]);
        assert!(matches!(open, Err(ConsoleError::NeedsToken(_))));
        assert!(Token::new("short").is_err() && Token::new(&"x".repeat(257)).is_err());
        let here = access("127.0.0.1:1", &[]);
        assert!(here.opens("0123456789abcdef"));
        for wrong in ["", "0123456789abcdeF", "0123456789abcde", "0123456789abcdef\0", "0123456789abcdef0"] {
            assert!(!here.opens(wrong), "{wrong:?}");
        }
        assert_eq!(format!("{:?}", Token::new("0123456789abcdef")), "Ok(Token(..))");
    }

    #[test]
    fn a_name_that_is_none_is_refused() {
        for name in ["", "http://robot", "robot:80", "a b", "*"] {
            let made = Access::new("127.0.0.1:1".parse().expect("address"), None, &[name.into()]);
            assert!(matches!(made, Err(ConsoleError::HostName(_))), "{name}");
        }
    }

    #[test]
    fn a_token_that_everybody_may_read_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("token");
        std::fs::write(&path, " 0123456789abcdef\n").expect("file");
        for (mode, good) in [(0o600, true), (0o640, true), (0o644, false)] {
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).expect("mode");
            assert_eq!(Token::load(&path).is_ok(), good, "{mode:o}");
        }
        assert!(Token::load(&folder.path().join("none")).is_err());
    }
}
