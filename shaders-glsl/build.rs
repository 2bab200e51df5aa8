//! Compiles every kernel under shaders-glsl/ and writes the Rust that calls it; builds the OpenCV shim.
//!
//! GLSL is the single source: `glslangValidator` makes SPIR-V, `reflect.rs` reads the interface out of
//! it, `emit.rs` writes `$OUT_DIR/kernels.rs`. A kernel with the line `// variants: subgroup, cpu` is compiled once
//! more with `SUBGROUP` defined, and again with `CPU`; the pipeline takes the last variant that the device can run.

#[path = "../drivers/build.rs"]
#[allow(dead_code)] // its `main`
mod drivers_build;
mod emit;
mod reflect;

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Kernels that measure a device or test the core, with the feature `instruments` alone.
const INSTRUMENTS: [&str; 2] = ["tests/bench/kernels", "tests/gpu/selftest"];

fn main() {
    opencv_shim();
    drivers_build::recordings("../shared/data");
    println!("cargo:rerun-if-changed=shaders-glsl");
    INSTRUMENTS.iter().for_each(|folder| println!("cargo:rerun-if-changed={folder}"));
    if let Err(errors) = kernels() {
        for e in errors {
            eprintln!("error: {e}");
        }
        std::process::exit(1);
    }
}

fn kernels() -> Result<(), Vec<String>> {
    let one = |e: String| vec![e];
    let out = PathBuf::from(std::env::var_os("OUT_DIR").ok_or_else(|| one("cargo sets OUT_DIR".into()))?);
    let mut files = Vec::new();
    let instruments = std::env::var_os("CARGO_FEATURE_INSTRUMENTS").is_some();
    for folder in std::iter::once("shaders-glsl").chain(INSTRUMENTS.into_iter().filter(|_| instruments)) {
        find(Path::new(folder), &mut files).map_err(|e| one(format!("{folder}: {e}")))?;
    }
    files.sort();
    let mut errors = Vec::new();
    let mut sources: Vec<emit::Source> = Vec::new();
    for file in &files {
        match compile(file, &out) {
            Ok(s) if sources.iter().any(|other| other.stem == s.stem) => {
                errors.push(format!("{}: another kernel has this name", file.display()));
            }
            Ok(s) => sources.push(s),
            Err(e) => errors.push(e),
        }
    }
    if !errors.is_empty() {
        return Err(errors);
    }
    sources.sort_by(|a, b| a.stem.cmp(&b.stem));
    let mut text = emit::emit(&sources)?;
    let mut hasher = DefaultHasher::new();
    for (_, _, spv) in sources.iter().flat_map(|s| &s.variants) {
        std::fs::read(spv).map_err(|e| one(format!("{spv}: {e}")))?.hash(&mut hasher);
    }
    text += &format!("/// Hash of every module.\npub const HASH: u64 = {};\n", hasher.finish());
    std::fs::write(out.join("kernels.rs"), text).map_err(|e| one(format!("kernels.rs: {e}")))
}

fn find(folder: &Path, files: &mut Vec<PathBuf>) -> std::io::Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            find(&path, files)?;
        } else if path.extension().is_some_and(|e| e == "comp") {
            files.push(path);
        }
    }
    Ok(())
}

fn compile(file: &Path, out: &Path) -> Result<emit::Source, String> {
    let place = file.display();
    let stem = file.file_stem().and_then(|s| s.to_str()).ok_or(format!("{place}: the name is not UTF-8"))?;
    let glsl = std::fs::read_to_string(file).map_err(|e| format!("{place}: {e}"))?;
    let declared = glsl.lines().find_map(|l| l.trim().strip_prefix("// variants:")).unwrap_or("");
    let defines = declared.split([',', ' ']).map(|v| v.trim().to_uppercase()).filter(|v| !v.is_empty());
    let mut variants = Vec::new();
    for define in std::iter::once(String::new()).chain(defines) {
        let spv = out.join(format!("{}.spv", emit::variant_name(stem, &define)));
        glslang(file, &define, &spv)?;
        let bytes = std::fs::read(&spv).map_err(|e| format!("{}: {e}", spv.display()))?;
        let words: Vec<u32> = bytes.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        let kernel = reflect::reflect(&words).map_err(|e| format!("{place}: {e}"))?;
        variants.push((define, kernel, spv.display().to_string()));
    }
    Ok(emit::Source { stem: stem.to_string(), variants })
}

fn glslang(file: &Path, define: &str, spv: &Path) -> Result<(), String> {
    let mut command = Command::new("glslangValidator");
    command.args(["-V", "--quiet", "--target-env", "vulkan1.1", "-Ishaders-glsl", "-o"]).arg(spv);
    if !define.is_empty() {
        command.arg(format!("-D{define}"));
    }
    let output = command
        .arg(file)
        .output()
        .map_err(|e| format!("cannot run glslangValidator: {e}; apt-get install glslang-tools"))?;
    if output.status.success() {
        return Ok(());
    }
    let said = String::from_utf8_lossy(&output.stdout);
    Err(format!(
        "{}{}{}",
        file.display(),
        if define.is_empty() { "" } else { " with -D" },
        format_args!("{define}:\n{said}")
    ))
}

/// Matching by OpenCV: a shared object of its own, which src/stereo/opencv.rs carries and loads.
fn opencv_shim() {
    let shim = "src/stereo/opencv.cpp";
    println!("cargo:rerun-if-changed={shim}");
    if std::env::var_os("CARGO_FEATURE_OPENCV").is_none() {
        return;
    }
    let headers = std::path::Path::new("/usr/include/opencv4");
    assert!(
        headers.join("opencv2/calib3d.hpp").exists(),
        "OpenCV's calib3d headers are missing: apt-get install libopencv-calib3d-dev, or build with --no-default-features"
    );
    let out = PathBuf::from(std::env::var_os("OUT_DIR").expect("cargo sets OUT_DIR")).join("stipple_opencv.so");
    let compiler = cc::Build::new().cpp(true).std("c++17").opt_level(2).debug(false).include(headers).get_compiler();
    let mut command = compiler.to_command();
    command.args(["-shared", "-fPIC", "-s", "-Wl,-z,defs", "-o"]).arg(out).arg(shim);
    let built = command.args(["-lopencv_calib3d", "-lopencv_core"]).status();
    assert!(built.is_ok_and(|status| status.success()), "cannot build {shim}");
}
