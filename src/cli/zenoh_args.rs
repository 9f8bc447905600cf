//! Which network of ROS 2 a subcommand speaks to: the same options everywhere.

use std::path::PathBuf;

/// Options of every subcommand that opens a Zenoh session.
#[derive(Debug, Clone, clap::Args)]
pub struct ZenohArgs {
    /// Zenoh's own configuration file [default: ZENOH_SESSION_CONFIG_URI, else a peer that connects to tcp/localhost:7447]
    #[arg(long, value_name = "FILE")]
    pub zenoh: Option<PathBuf>,
    /// ROS 2's domain
    #[arg(long, env = "ROS_DOMAIN_ID", value_name = "N", default_value = "0", value_parser = domain)]
    pub domain: u32,
}

impl ZenohArgs {
    /// Zenoh's own configuration file, if any is named.
    pub fn file(&self) -> Option<PathBuf> {
        let from_environment = || std::env::var_os("ZENOH_SESSION_CONFIG_URI").filter(|path| !path.is_empty());
        self.zenoh.clone().or_else(|| from_environment().map(PathBuf::from))
    }
}

/// The highest domain of ROS 2: higher ones have no ports in DDS.
const HIGHEST_DOMAIN: u32 = 232;

/// ROS_DOMAIN_ID may be set and empty, which is the same as not set.
fn domain(text: &str) -> Result<u32, String> {
    let domain = if text.is_empty() { Ok(0) } else { text.parse::<u32>() };
    let domain = domain.ok().filter(|domain| *domain <= HIGHEST_DOMAIN);
    domain.ok_or_else(|| format!("a domain of ROS 2 is a number from 0 to {HIGHEST_DOMAIN}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_domain_is_a_number_that_ros_takes() {
        assert_eq!((domain(""), domain("7"), domain("232")), (Ok(0), Ok(7), Ok(232)));
        assert!(["233", "-1", "x"].iter().all(|text| domain(text).is_err()));
    }
}
