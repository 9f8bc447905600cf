//! Shared memory and iceoryx2's folder: room, owner, mode.

use std::os::unix::fs::MetadataExt;
use std::path::Path;

use super::report::Report;
use crate::messages::Squatter;

/// Shared memory that a daemon of default size takes, with room to spare, bytes.
const SHM_NEEDED: u64 = 64 << 20;

/// Room for the daemon's messages.
pub fn shared_memory(report: &mut Report, daemon_runs: bool) {
    report.title("shared memory");
    match rustix::fs::statvfs("/dev/shm") {
        Ok(stat) => {
            let size = |blocks: u64| blocks.saturating_mul(stat.f_frsize);
            judge_room(report, size(stat.f_bavail), size(stat.f_blocks), daemon_runs);
        }
        Err(error) => report.bad(&format!("/dev/shm: {error}"), "mount a tmpfs on /dev/shm"),
    }
}

/// `free` and `total` bytes. A daemon that runs has taken its share; it is ended by SIGBUS when a page of it is not to be had.
fn judge_room(report: &mut Report, free: u64, total: u64, daemon_runs: bool) {
    let needed = if daemon_runs { SHM_NEEDED / 4 } else { SHM_NEEDED };
    let line = format!("/dev/shm: {} MB free of {} MB", free >> 20, total >> 20);
    if free < needed {
        let next =
            "make room: `ls -l /dev/shm` shows whose files they are; or `sudo mount -o remount,size=256M /dev/shm`";
        report.bad(&format!("{line}, {} MB are needed", needed >> 20), next);
    } else {
        report.good(&line);
    }
}

/// What another user has put into the place of iceoryx2's common counter keeps everybody from starting.
pub fn counter(report: &mut Report, squatter: Option<Squatter>) {
    if let Some(squatter) = squatter {
        let next = format!("end what uses iceoryx2, then `sudo rm -r {}`", squatter.path.display());
        report.bad(&squatter.to_string(), &next);
    }
}

/// Files of the wire that another user owns keep this user from connecting.
pub fn root(
    report: &mut Report,
    root: &Path,
    us: Option<u32>,
    service_uid: Option<u32>,
    name_of: &dyn Fn(u32) -> String,
) {
    report.title("iceoryx2");
    let shown = root.display();
    let meta = match std::fs::symlink_metadata(root) {
        Ok(meta) => meta,
        Err(_) => return report.good(&format!("{shown} does not exist yet: made at the first start")),
    };
    let (owner, mode) = (meta.uid(), meta.mode() & 0o7777);
    let again = "while nothing runs: `sudo rm -r /tmp/iceoryx2`; then `sudo systemd-tmpfiles --create cairn.conf` where the service \
                 is installed";
    if !meta.is_dir() {
        return report.bad(&format!("{shown} is no folder, somebody put something else there"), again);
    }
    if mode & 0o022 != 0 {
        report.bad(&format!("{shown} can be written by others (mode {mode:o}): any user can get in the way"), again);
    }
    let name = name_of(owner);
    if Some(owner) == us {
        report.good(&format!("{shown} belongs to this user"));
        if service_uid.is_some_and(|service| service != owner) {
            report.bad(&format!("but the service's user cairn cannot use it, {name} owns it"), again);
        }
    } else if Some(owner) == service_uid {
        report.note(&format!(
            "{shown} belongs to the service's user: planners and `cairn watch` run as {name} (`sudo -u {name} ...`)"
        ));
    } else {
        let this = us.map_or("unknown".into(), name_of);
        report.bad(
            &format!("{shown} belongs to user {name}, this is user {this}: neither hears the other"),
            "run daemon and planners as one user, or remove the folder while nothing runs: `sudo rm -r /tmp/iceoryx2`",
        );
    }
}

/// User id of a name in a passwd file.
pub fn user_id(passwd: &str, name: &str) -> Option<u32> {
    let line = passwd.lines().find(|line| line.split(':').next() == Some(name))?;
    line.split(':').nth(2)?.parse().ok()
}

/// Name of a user id in a passwd file.
pub fn user_of(passwd: &str, uid: u32) -> Option<&str> {
    let id = |line: &&str| line.split(':').nth(2).and_then(|id| id.parse().ok()) == Some(uid);
    passwd.lines().find(id)?.split(':').next()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn a_full_dev_shm_is_a_fault_also_while_a_daemon_runs() {
        for (free, runs, problems) in [(100, false, 0), (63, false, 1), (63, true, 0), (15, true, 1), (0, true, 1)] {
            let mut report = Report::default();
            judge_room(&mut report, free << 20, 200 << 20, runs);
            assert_eq!(report.problems, problems, "{free} MB free, daemon {runs}: {}", report.text);
        }
    }

    #[test]
    fn a_squatter_in_shared_memory_is_a_fault_with_its_cure() {
        let mut report = Report::default();
        counter(&mut report, None);
        assert_eq!(report.problems, 0);
        let path = "/dev/shm/iox2_1_node.global_mgmt".into();
        counter(&mut report, Some(Squatter { path, owner: 65_534, fault: "is empty" }));
        assert!(
            report.problems == 1 && report.text.contains("65534") && report.next[0].contains("sudo rm"),
            "{}",
            report.text
        );
    }

    #[test]
    fn a_folder_of_somebody_else_is_told_from_the_services() {
        let dir = tempfile::tempdir().expect("folder");
        let folder = dir.path().join("iceoryx2");
        let judge = |us: u32, service: Option<u32>| {
            let mut report = Report::default();
            root(&mut report, &folder, Some(us), service, &|uid| format!("u{uid}"));
            report
        };
        assert_eq!(judge(1, None).problems, 0, "not there yet");
        std::fs::create_dir(&folder).expect("folder");
        std::fs::set_permissions(&folder, PermissionsExt::from_mode(0o750)).expect("mode");
        let owner = std::fs::metadata(&folder).expect("metadata").uid();
        assert_eq!(judge(owner, None).problems, 0);
        assert_eq!(judge(owner + 1, Some(owner)).problems, 0, "the service's");
        for (us, service, part) in [
            (owner + 1, None, "neither hears the other"),
            (owner + 1, Some(owner + 2), "neither hears the other"),
            (owner, Some(owner + 2), "cannot use it"),
        ] {
            let report = judge(us, service);
            assert!(report.problems == 1 && report.text.contains(part), "{us} {service:?}: {}", report.text);
        }
        std::fs::set_permissions(&folder, PermissionsExt::from_mode(0o777)).expect("mode");
        assert!(judge(owner, None).text.contains("written by others"));
        std::fs::remove_dir(&folder).expect("removed");
        std::fs::write(&folder, "squatter").expect("written");
        assert!(judge(owner, None).text.contains("is no folder"));
    }

    #[test]
    fn users_are_found_by_name() {
        let passwd = "root:x:0:0:root:/root:/bin/sh\ncairn:x:998:997::/var/lib/cairn:/usr/sbin/nologin\nbroken\n";
        assert_eq!(user_id(passwd, "cairn"), Some(998));
        assert_eq!((user_of(passwd, 998), user_of(passwd, 5)), (Some("cairn"), None));
        assert_eq!((user_id(passwd, "cair"), user_id(passwd, "broken")), (None, None));
    }
}
