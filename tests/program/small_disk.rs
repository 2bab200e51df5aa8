//! A disk of a few megabytes, to be filled.

use std::io::{self, Write};
use std::path::Path;
use std::process::Command;

/// Unmounts a disk, whatever became of the test.
struct Mounted<'a>(&'a Path);

impl Drop for Mounted<'_> {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(self.0).status();
    }
}

/// Runs `body` on a disk of this size. Where mounting is refused, the test runs itself again as root of a namespace of
/// its own; where that is refused too, it is left out and says so, or fails if STIPPLE_REQUIRE_MOUNT is 1.
pub fn on_a_small_disk(size: &str, test: &str, body: impl FnOnce(&Path)) {
    let size = format!("size={size}");
    let mount = ["mount", "-t", "tmpfs", "-o", &size, "tmpfs"];
    const NAMESPACE: [&str; 2] = ["unshare", "-Umr"];
    let dir = tempfile::tempdir().unwrap();
    let runs = |words: &[&str]| {
        let output = Command::new(words[0]).args(&words[1..]).arg(dir.path()).output();
        output.is_ok_and(|o| o.status.success())
    };
    if runs(&mount) {
        let _disk = Mounted(dir.path());
        body(dir.path());
    } else if runs(&[&NAMESPACE[..], &mount].concat()) {
        let own = std::env::current_exe().unwrap();
        let again =
            Command::new(NAMESPACE[0]).arg(NAMESPACE[1]).arg(own).args(["--exact", test, "--nocapture"]).output();
        let again = again.unwrap();
        let said = String::from_utf8_lossy(&again.stdout);
        assert!(
            again.status.success() && said.contains("1 passed"),
            "{said}{}",
            String::from_utf8_lossy(&again.stderr)
        );
    } else {
        assert!(std::env::var("STIPPLE_REQUIRE_MOUNT").as_deref() != Ok("1"), "a small disk cannot be mounted here");
        // Past the capture of output, which shows what passed tests print to nobody.
        let _ = writeln!(io::stderr(), "LEFT OUT: {test}: a small disk cannot be mounted here, nor in a namespace");
    }
}
