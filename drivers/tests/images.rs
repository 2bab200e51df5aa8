//! The reader of images: every format that may be there, damage of every kind; and garbage in any file of a recording.
#![allow(clippy::unwrap_used)]

mod folder;

use folder::{grey, png, Folder, FRAME, H, T0, W};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use std::fs;
use stipple_drivers::replay::*;
use stipple_drivers::Frames;

/// Replaces the first image of camera 1 and reads the first pair.
fn read_with(image: &[u8]) -> (Result<(), ImageFault>, Vec<u8>, Reader) {
    let f = Folder::new();
    f.write(&format!("cam1/data/{T0}.png"), image);
    let r = f.open().unwrap();
    let (mut reader, mut frames) = (r.reader(), Frames::for_rig(&r.calibration));
    let result = reader.read(0, &mut frames);
    assert_eq!(reader.read(1, &mut frames), Ok(()), "a bad image does not spoil the next pair");
    assert_eq!(reader.warnings().len(), usize::from(result.is_err()));
    r.reader().read(1, &mut frames).unwrap();
    let _ = reader.read(0, &mut frames);
    (result, frames.images.swap_remove(1).pixels, reader)
}

#[test]
fn every_png_format_becomes_grey() {
    use png::{BitDepth::*, ColorType::*};
    let grey = grey();
    let wide: Vec<u8> = grey.iter().flat_map(|g| [*g, 0xff - *g]).collect();
    assert_eq!(read_with(&png(Grayscale, Sixteen, W, H, &wide)).1, grey, "the high byte");
    let alpha: Vec<u8> = grey.iter().flat_map(|g| [*g, 9]).collect();
    assert_eq!(read_with(&png(GrayscaleAlpha, Eight, W, H, &alpha)).1, grey);
    let rgb: Vec<u8> = grey.iter().flat_map(|g| [*g, *g, *g]).collect();
    assert_eq!(read_with(&png(Rgb, Eight, W, H, &rgb)).1, grey);
    let rgba: Vec<u8> = grey.iter().flat_map(|g| [0, *g, 0, 255]).collect();
    let green = read_with(&png(Rgba, Eight, W, H, &rgba)).1;
    assert!(green.iter().zip(&grey).all(|(a, g)| (f64::from(*a) - 0.587 * f64::from(*g)).abs() < 1.0));
    let bits = vec![0b1010_1010u8; W * H / 8];
    assert_eq!(read_with(&png(Grayscale, One, W, H, &bits)).1[..2], [255, 0]);
}

#[test]
fn colour_is_given_beside_the_same_grey() {
    use png::{BitDepth::*, ColorType::*};
    let rgb: Vec<u8> = grey().iter().flat_map(|g| [*g, 255 - *g, g.wrapping_mul(3)]).collect();
    let f = Folder::new();
    f.write(&format!("cam0/data/{T0}.png"), png(Rgb, Eight, W, H, &rgb));
    let r = f.open().unwrap();
    let (mut plain, mut coloured) = (Frames::for_rig(&r.calibration), Frames::in_colour(&r.calibration, 2));
    let mut reader = r.reader();
    reader.read(0, &mut plain).unwrap();
    reader.read(0, &mut coloured).unwrap();
    assert_eq!(plain.images, coloured.images, "tracking sees the same");
    for (c, plane) in coloured.colours[0].iter().enumerate() {
        assert!(plane.pixels.iter().eq(rgb.iter().skip(c).step_by(3)), "channel {c}");
    }
    // A grey file's channels are equal.
    coloured.colours[1].iter().for_each(|plane| assert_eq!(*plane, coloured.images[1]));
    assert!(reader.has_colour(1) && !reader.has_colour(2) && reader.has_colour(0));
}

/// The left half of halves.jpg is (200, 80, 40), the right half (30, 90, 210).
#[test]
fn a_colour_jpeg_gives_its_colours_and_its_own_luma() {
    let f = Folder::new();
    f.write(&format!("cam0/data/{T0}.png"), include_bytes!("folder/halves.jpg"));
    let r = f.open().unwrap();
    let (mut plain, mut coloured) = (Frames::for_rig(&r.calibration), Frames::in_colour(&r.calibration, 1));
    let mut reader = r.reader();
    reader.read(0, &mut plain).unwrap();
    reader.read(0, &mut coloured).unwrap();
    assert_eq!(plain.images, coloured.images, "tracking sees the same");
    for (c, plane) in coloured.colours[0].iter().enumerate() {
        for i in 0..W * H {
            let expected = if i % W < W / 2 { [200, 80, 40][c] } else { [30, 90, 210][c] };
            assert!(plane.pixels[i].abs_diff(expected) < 6, "pixel {i}, channel {c}: {}", plane.pixels[i]);
        }
    }
    assert!(reader.has_colour(1));
}

#[test]
fn damaged_images_are_counted_and_name_their_row() {
    let good = png(png::ColorType::Grayscale, png::BitDepth::Eight, W, H, &grey());
    let small = png(png::ColorType::Grayscale, png::BitDepth::Eight, W, H - 1, &grey()[W..]);
    let cases: [(&[u8], ImageFault); 6] = [
        (&good[..good.len() / 2], ImageFault::Undecodable),
        (&good[..good.len() - 4], ImageFault::Undecodable),
        (&good[..4], ImageFault::Undecodable),
        (b"", ImageFault::Undecodable),
        (b"GIF89a", ImageFault::Undecodable),
        (&small, ImageFault::WrongSize),
    ];
    for (image, kind) in cases {
        let (result, _, reader) = read_with(image);
        let said = &reader.warnings()[0];
        assert_eq!(result, Err(kind), "{said}");
        assert!(said.contains("cam1/data.csv:2: ") && said.contains(&format!("{T0}.png")), "{said}");
        assert_eq!(reader.counters().images_undecodable + reader.counters().images_wrong_size, 2);
    }
    let f = Folder::new();
    let path = f.path(&format!("cam0/data/{T0}.png"));
    let read = |fault| {
        let r = f.open().unwrap();
        let mut reader = r.reader();
        assert_eq!(reader.read(0, &mut Frames::for_rig(&r.calibration)), Err(fault));
        reader.counters().clone()
    };
    fs::remove_file(&path).unwrap();
    assert_eq!(read(ImageFault::Missing).images_missing, 1);
    // Neither waited for nor read without end.
    std::os::unix::fs::symlink("/dev/zero", &path).unwrap();
    assert_eq!(read(ImageFault::Missing).images_missing, 1);
    fs::remove_file(&path).unwrap();
    fs::File::create(&path).unwrap().set_len(1 << 40).unwrap();
    assert_eq!(read(ImageFault::Undecodable).images_undecodable, 1);
}

/// While one image that could not be read cost the frame, a camera whose files are missing cost every one.
#[test]
fn a_frame_is_given_as_long_as_one_of_its_images_can_be_read() {
    let f = Folder::new();
    fs::remove_file(f.path(&format!("cam0/data/{T0}.png"))).unwrap();
    let r = f.open().unwrap();
    let (mut reader, mut frames) = (r.reader(), Frames::in_colour(&r.calibration, 1));
    reader.read(1, &mut frames).unwrap();
    assert_eq!(reader.read_any(0, &mut frames), Ok(()));
    assert!(frames.images.iter().zip([vec![0; W * H], grey()]).all(|(image, pixels)| image.pixels == pixels));
    assert!(frames.colours[0].iter().all(|plane| plane.pixels.iter().all(|px| *px == 0)));
    assert_eq!(reader.counters().images_missing, 1);
    f.write(&format!("cam1/data/{T0}.png"), b"no image");
    assert_eq!(reader.read_any(0, &mut frames), Err(ImageFault::Missing));
    assert_eq!((reader.counters().images_missing, reader.counters().images_undecodable), (2, 1));
}

#[test]
fn images_are_taken_from_the_recording_alone() {
    for file in ["../../cam1/data/1.png", "/etc/passwd", "a/b.png", ".."] {
        let f = Folder::new();
        f.edit("cam0/data.csv", 3, |_| format!("{},{file}", T0 + FRAME));
        let r = f.open().unwrap();
        assert_eq!((r.counters.rows_malformed, r.frames.iter().any(|f| f.t.0 == T0 + FRAME)), (1, false), "{file}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 150, failure_persistence: None, rng_seed: RngSeed::Fixed(1), ..ProptestConfig::default() })]

    /// Whatever is in one file, opening and reading answer; they never panic.
    #[test]
    fn garbage_in_any_file_never_panics(
        name in prop::sample::select(vec!["cam0/data.csv", "cam1/data.csv", "imu0/data.csv", "cam0/sensor.yaml",
            "imu0/sensor.yaml", "state_groundtruth_estimate0/data.csv", "cam0/data/1000000000.png"]),
        at in 0.0..1.0f64,
        length in 0usize..60,
        garbage in prop::collection::vec(any::<u8>(), 0..60),
        text in "[-0-9.,:# \\n\\[\\]{}a-zA-Z\"&*!]{0,40}",
        as_text in any::<bool>(),
    ) {
        let f = Folder::new();
        let mut bytes = fs::read(f.path(name)).unwrap();
        let start = (at * bytes.len() as f64) as usize;
        let end = (start + length).min(bytes.len());
        bytes.splice(start..end, if as_text { text.into_bytes() } else { garbage });
        f.write(name, &bytes);
        if let Ok(r) = f.open() {
            let (mut reader, mut frames) = (r.reader(), Frames::for_rig(&r.calibration));
            for i in 0..r.frames.len() {
                let _ = reader.read(i, &mut frames);
            }
            prop_assert!(r.imu.iter().all(|s| s.is_finite()));
            prop_assert!(r.imu.windows(2).all(|s| s[0].t < s[1].t));
        }
    }

    #[test]
    fn pure_garbage_never_panics(garbage in prop::collection::vec(any::<u8>(), 0..400), kind in 0usize..3) {
        let f = Folder::new();
        let magic: [&[u8]; 3] = [b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0\x00\x10JFIF"];
        let bytes = [magic[kind], &garbage].concat();
        f.write("x.yaml", &bytes);
        let _ = read_calibration(&f.path("x.yaml"));
        let _ = read_trajectory(&f.path("x.yaml"));
        prop_assert!(read_with(&bytes).0.is_err());
    }
}
