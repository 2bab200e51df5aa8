fn main() {
    opencv_shim();
}

/// Block matching from Debian's OpenCV; see src/stereo/bm.rs.
fn opencv_shim() {
    let shim = "src/stereo/bm_opencv.cpp";
    println!("cargo:rerun-if-changed={shim}");
    if std::env::var_os("CARGO_FEATURE_OPENCV").is_none() {
        return;
    }
    let headers = std::path::Path::new("/usr/include/opencv4");
    assert!(
        headers.join("opencv2/calib3d.hpp").exists(),
        "OpenCV's calib3d headers are missing: apt-get install libopencv-calib3d-dev, or build with --no-default-features"
    );
    cc::Build::new().cpp(true).std("c++17").opt_level(2).include(headers).file(shim).compile("stipple_bm_opencv");
    println!("cargo:rustc-link-lib=opencv_calib3d");
    println!("cargo:rustc-link-lib=opencv_core");
}
