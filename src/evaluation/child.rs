//! A child process with a bounded wait and its costs, as the kernel counted them.
//!
//! Input: a command and a limit. Output: how it ended, wall time, CPU time of all its threads and its peak resident memory.
//! The peak is the kernel's `ru_maxrss`, which also remembers the size that the caller had when it started the child: a
//! caller that has been large itself would be seen in it, so start children before drawing pictures.
//!
//! Deliberately not here: reading the child's output; give it files.

use std::io;
use std::os::unix::process::ExitStatusExt;
use std::process::{Command, ExitStatus};
use std::time::{Duration, Instant};

/// How a child ended and what it took.
#[derive(Debug, Clone, Copy)]
pub struct Usage {
    pub status: ExitStatus,
    pub wall_s: f64,
    pub cpu_s: f64,
    /// MiB.
    pub peak_rss_mb: f64,
}

/// Why there is no [`Usage`].
#[derive(Debug, thiserror::Error)]
pub enum ChildError {
    #[error("cannot start {program}: {source}")]
    Start { program: String, source: io::Error },
    #[error("did not end within {0} s and was killed")]
    TimedOut(u64),
    #[error("cannot wait for it: {0}")]
    Wait(io::Error),
}

const POLL: Duration = Duration::from_millis(10);
/// A killed process that is stuck in the kernel is given up after this.
const KILL_LIMIT: Duration = Duration::from_secs(10);

/// Runs `command` to its end, or kills it after `limit`.
pub fn run_bounded(command: &mut Command, limit: Duration) -> Result<Usage, ChildError> {
    let start = Instant::now();
    let mut child = command.spawn().map_err(|source| {
        let program = command.get_program().to_string_lossy().into_owned();
        ChildError::Start { program, source }
    })?;
    match poll_until(child.id(), start, limit)? {
        Some(usage) => Ok(usage),
        None => {
            // Not reaped yet, so its id cannot have become another process's.
            child.kill().map_err(ChildError::Wait)?;
            poll_until(child.id(), Instant::now(), KILL_LIMIT)?;
            Err(ChildError::TimedOut(limit.as_secs()))
        }
    }
}

fn poll_until(id: u32, start: Instant, limit: Duration) -> Result<Option<Usage>, ChildError> {
    loop {
        if let Some((status, usage)) = wait4_now(id).map_err(ChildError::Wait)? {
            let seconds = |t: libc::timeval| t.tv_sec as f64 + t.tv_usec as f64 * 1e-6;
            return Ok(Some(Usage {
                status: ExitStatus::from_raw(status),
                wall_s: start.elapsed().as_secs_f64(),
                cpu_s: seconds(usage.ru_utime) + seconds(usage.ru_stime),
                // Linux counts it in KiB.
                peak_rss_mb: usage.ru_maxrss as f64 / 1024.0,
            }));
        }
        if start.elapsed() >= limit {
            return Ok(None);
        }
        std::thread::sleep(POLL);
    }
}

/// Reaps the child if it has ended. The standard library does not hand out what the kernel counted for one child.
fn wait4_now(id: u32) -> io::Result<Option<(libc::c_int, libc::rusage)>> {
    let mut status = 0;
    let mut usage = std::mem::MaybeUninit::<libc::rusage>::zeroed();
    // SAFETY: both pointers are to live, writable memory of the right types; `id` is our own child, which nobody else reaps.
    let reaped = unsafe { libc::wait4(id as libc::pid_t, &mut status, libc::WNOHANG, usage.as_mut_ptr()) };
    match reaped {
        0 => Ok(None),
        // SAFETY: an all-zero `rusage` is a valid value, and the kernel has filled it since.
        r if r > 0 => Ok(Some((status, unsafe { usage.assume_init() }))),
        _ => match io::Error::last_os_error() {
            e if e.kind() == io::ErrorKind::Interrupted => Ok(None),
            e => Err(e),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shell(script: &str) -> Command {
        let mut command = Command::new("/bin/sh");
        command.args(["-c", script]);
        command
    }

    #[test]
    fn the_exit_code_and_the_costs_are_the_childs_own() {
        let busy = "i=0; while [ $i -lt 200000 ]; do i=$((i+1)); done; exit 7";
        let usage = run_bounded(&mut shell(busy), Duration::from_secs(60)).unwrap();
        assert_eq!(usage.status.code(), Some(7));
        let idle = run_bounded(&mut shell("true"), Duration::from_secs(60)).unwrap();
        assert!(usage.cpu_s > idle.cpu_s && idle.cpu_s >= 0.0, "{usage:?} {idle:?}");
        assert!(idle.peak_rss_mb > 0.1, "{idle:?}");
    }

    #[test]
    fn a_child_that_hangs_is_killed_and_reaped() {
        let error = run_bounded(&mut shell("exec sleep 1000"), Duration::ZERO).unwrap_err();
        assert!(matches!(error, ChildError::TimedOut(0)), "{error}");
        let error = run_bounded(&mut Command::new("/no/such/program"), Duration::from_secs(1)).unwrap_err();
        assert!(error.to_string().contains("/no/such/program"), "{error}");
    }
}
