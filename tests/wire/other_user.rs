//! Another user's shared memory: a clear refusal and not silence. Needs root to become somebody else; says so otherwise.

use std::os::unix::process::CommandExt;
use std::process::Command;

use cairn::client::{Client, ClientError};
use cairn::messages::effective_uid;
use cairn::publish::{PublishError, Publisher};

use crate::support::{Place, small};

const NOBODY: u32 = 65_534;
const ROOT: &str = "CAIRN_TEST_ROOT";

#[test]
fn another_users_daemon_is_refused_with_the_reason_and_the_cure() {
    if effective_uid() != Some(0) {
        println!("skipped: only root can try to be another user");
        return;
    }
    let place = Place::new();
    let _publisher = place.publisher();
    // The test binary lies where nobody else may read; a copy can be run.
    let copy = tempfile::Builder::new().prefix("cw").tempdir_in("/tmp").expect("folder");
    let binary = copy.path().join("wire");
    std::fs::copy(std::env::current_exe().expect("own path"), &binary).expect("copy");
    let open = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    std::fs::set_permissions(copy.path(), open).expect("chmod");
    let output = Command::new(&binary)
        .args(["--ignored", "--exact", "other_user::as_nobody", "--nocapture"])
        .env(ROOT, place.root())
        .current_dir("/")
        .uid(NOBODY)
        .gid(NOBODY)
        .output()
        .expect("helper");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
}

/// Not a test: what the helper runs as another user.
#[test]
#[ignore = "started by another test"]
fn as_nobody() {
    let Some(root) = std::env::var_os(ROOT) else { return };
    let endpoint = crate::support::endpoint(root.as_ref());
    let error = Client::with_endpoint(endpoint.clone()).expect_err("refused");
    assert!(matches!(error, ClientError::OtherOwner { owner: 0, .. }), "{error}");
    let message = error.to_string();
    assert!(message.contains("root (0)") && message.contains("same user"), "{message}");
    let error = Publisher::open(&endpoint, &small()).expect_err("refused");
    assert!(matches!(error, PublishError::OtherOwner { owner: 0, .. }), "{error}");
}

#[test]
fn root_is_refused_by_another_users_daemon_instead_of_hearing_nothing() {
    if effective_uid() != Some(0) {
        println!("skipped: only root can hand files to another user");
        return;
    }
    let place = Place::new();
    let _publisher = place.publisher();
    let services = place.root().join("services");
    for entry in std::fs::read_dir(&services).expect("services").flatten() {
        std::os::unix::fs::chown(entry.path(), Some(NOBODY), None).expect("chown");
    }
    let error = Client::with_endpoint(place.endpoint()).expect_err("refused");
    assert!(matches!(error, ClientError::OtherOwner { owner: NOBODY, .. }), "{error}");
    assert!(error.to_string().contains(&NOBODY.to_string()), "{error}");
}
