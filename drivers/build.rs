//! Tells the tests whether there are recordings, so that those that need one are listed as ignored
//! where there is none. The root package's build script calls this too.

fn main() {
    recordings("../../shared/data");
}

/// Sets `cfg(recordings)`. `beside` is where they are looked for without $STIPPLE_RECORDINGS.
pub fn recordings(beside: &str) {
    println!("cargo:rerun-if-env-changed=STIPPLE_RECORDINGS");
    println!("cargo:rustc-check-cfg=cfg(recordings)");
    let folder = std::env::var("STIPPLE_RECORDINGS").unwrap_or_else(|_| beside.to_string());
    // A folder that is not there is not watched: cargo would build anew each time.
    if std::path::Path::new(&folder).is_dir() {
        println!("cargo:rerun-if-changed={folder}");
        println!("cargo:rustc-cfg=recordings");
    }
}
